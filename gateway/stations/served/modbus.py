"""Modbus requests to served stations (application protocol V1.1b3, 6): PDU in, PDU out.

Exceptions: 01 for the function, 03 for counts and values, 02 for addresses without a tag or outside
`accept`, 04 for a value that is not known.
"""

from collections.abc import Iterator, Sequence
from struct import pack, unpack_from
from typing import NamedTuple

from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus.frame import (
    EXCEPTION,
    READ_BITS,
    READ_WORDS,
    WRITE_MANY,
    WRITE_SINGLE,
)
from gateway.stations.modbus.store import Part, Runs, parts_of, runs_by_function
from gateway.stations.served.answering import Done
from gateway.stations.served.registers import Cell, Denied, Registers, Why, Written

_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE, _FAILURE = 1, 2, 3, 4
_MOST = {1: 2000, 2: 2000, 3: 125, 4: 125, 15: 1968, 16: 123}
_WRITES = (*WRITE_SINGLE, *WRITE_MANY)


class Answer(NamedTuple):
    """The PDU of the reply, and the effect of the request."""

    pdu: bytes
    done: Done


class _Refusal(Exception):
    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class ModbusData:
    """One station: its registers behind the wire addresses of its dialect."""

    def __init__(self, driver: AnyDriver, registers: Registers) -> None:
        self._station = driver.station
        self._registers = registers
        dialect: str = getattr(driver, "addressing", "plain")
        self._runs = runs_by_function(dialect)
        self._low_first = getattr(driver, "counter_word_order", "low_first") == "low_first"

    def answer(self, pdu: bytes) -> Answer:
        """Carries out a request. The reply to a broadcast is not sent."""
        function = pdu[0]
        write = function in _WRITES
        try:
            reply, written = self._serve(function, pdu)
        except _Refusal as refusal:
            code = refusal.code
        except Denied as denied:
            code = _FAILURE if denied.why is Why.BAD else _ILLEGAL_ADDRESS
        else:
            return Answer(reply, Done(self._station, "", write, tuple(written)))
        refused = bytes((function | EXCEPTION, code))
        return Answer(refused, Done(self._station, f"{code:02X}", write))

    def _serve(self, function: int, pdu: bytes) -> tuple[bytes, Written]:
        """Returns the reply and the written tags. Raises `_Refusal`, `Denied`."""
        runs = self._runs.get(function)
        if runs is None:
            raise _Refusal(_ILLEGAL_FUNCTION)
        if function in _WRITES:
            wire, units = _written(function, pdu)
            written = self._write(self._parts(runs, wire, len(units)), units)
            return pdu[:5], written
        if len(pdu) != 5:
            raise _Refusal(_ILLEGAL_VALUE)
        wire, count = unpack_from(">HH", pdu, 1)
        if not 1 <= count <= _MOST[function]:
            raise _Refusal(_ILLEGAL_VALUE)
        units = self._read(self._parts(runs, wire, count))
        return bytes((function,)) + _packed(function, units), ()

    def _parts(self, runs: Runs, wire: int, count: int) -> list[Part]:
        parts = list(parts_of(runs, wire, count))
        if sum(part.size for part in parts) != count:
            raise _Refusal(_ILLEGAL_ADDRESS)
        return parts

    def _read(self, parts: Sequence[Part]) -> list[int]:
        units: list[int] = []
        for run, ahead, size in parts:
            if not run.halves:
                units += self._registers.read(run.area, run.first + ahead, size)
                continue
            first, last = ahead // 2, (ahead + size - 1) // 2
            wide = self._registers.read(run.area, run.first + first, last - first + 1)
            words = [half for unit in wide for half in self._halves(unit)]
            units += words[ahead % 2 :][:size]
        return units

    def _halves(self, unit: int) -> tuple[int, int]:
        low, high = unit & 0xFFFF, unit >> 16 & 0xFFFF
        return (low, high) if self._low_first else (high, low)

    def _write(self, parts: Sequence[Part], units: Sequence[int]) -> Written:
        """Writes all parts as one. Raises `Denied`, and then nothing is written."""
        given = iter(units)
        cells: list[tuple[Cell, int]] = []
        for part in parts:
            piece = [next(given) for _ in range(part.size)]
            cells += self._joined(part, piece) if part.run.halves else _cells(part, piece)
        return self._registers.write_cells(cells)

    def _joined(self, part: Part, words: Sequence[int]) -> Iterator[tuple[Cell, int]]:
        if part.ahead % 2 or len(words) % 2:
            raise Denied(Why.PART)
        first = part.run.first + part.ahead // 2
        for place in range(0, len(words), 2):
            one, other = words[place : place + 2]
            low, high = (one, other) if self._low_first else (other, one)
            yield (part.run.area, first + place // 2), low | high << 16


def _cells(part: Part, units: Sequence[int]) -> Iterator[tuple[Cell, int]]:
    for place, unit in enumerate(units):
        yield (part.run.area, part.run.first + part.ahead + place), unit


def _written(function: int, pdu: bytes) -> tuple[int, list[int]]:
    """Returns the wire address and the units of a write. Raises `_Refusal` 03."""
    if len(pdu) < 5:
        raise _Refusal(_ILLEGAL_VALUE)
    wire, second = unpack_from(">HH", pdu, 1)
    if function in WRITE_SINGLE:
        if len(pdu) != 5 or (function == 5 and second not in (0xFF00, 0)):
            raise _Refusal(_ILLEGAL_VALUE)
        return wire, [int(second == 0xFF00) if function == 5 else second]
    size = (second + 7) // 8 if function == 15 else 2 * second
    if not 1 <= second <= _MOST[function] or len(pdu) != 6 + size or pdu[5] != size:
        raise _Refusal(_ILLEGAL_VALUE)
    if function == 15:
        return wire, [pdu[6 + i // 8] >> i % 8 & 1 for i in range(second)]
    return wire, list(unpack_from(f">{second}H", pdu, 6))


def _packed(function: int, units: Sequence[int]) -> bytes:
    """Returns byte count and data of a reply to a read."""
    if function in READ_WORDS:
        return bytes((2 * len(units),)) + pack(f">{len(units)}H", *units)
    if function not in READ_BITS:
        raise AssertionError(f"function {function} reads nothing")
    data = bytearray((len(units) + 7) // 8)
    for place, bit in enumerate(units):
        data[place // 8] |= (bit & 1) << place % 8
    return bytes((len(data),)) + bytes(data)
