"""Modbus requests to a station (application protocol V1.1b3, 6 and 7): PDU in, PDU out.

Exceptions come in the standard's order: 01 for the function, 03 for counts and values, 02 for the
addresses, 04 for a value that is not known.
"""

from collections.abc import Mapping, Sequence
from struct import pack, unpack_from
from typing import NamedTuple

from gateway.protocols.modbus.frame import (
    EXCEPTION,
    READ_BITS,
    READ_WORDS,
    WRITE_MANY,
    WRITE_SINGLE,
)
from gateway.stations.modbus.dialects import RunPiece, Runs, parts_of, runs_by_function
from gateway.stations.store import Cell, Denied, Rejected, Store, Why, Written

_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE, _FAILURE = "01", "02", "03", "04"
MOST: Mapping[int, int] = {1: 2000, 2: 2000, 3: 125, 4: 125, 15: 1968, 16: 123}
_CODES = {Why.BAD: _FAILURE, Why.ROLE: _ILLEGAL_FUNCTION}  # Modbus/TCP Security: 01 for a role
_WRITES = (*WRITE_SINGLE, *WRITE_MANY)


class Answer(NamedTuple):
    """The PDU of the reply, and the effect of the request."""

    pdu: bytes
    refused: str = ""  # the exception code
    written: Written = ()


class ModbusData:
    """One station: its data behind the wire addresses of its dialect."""

    def __init__(
        self,
        store: Store,
        dialect: str = "plain",
        *,
        low_first: bool = True,
        most: Mapping[int, int] = MOST,
    ) -> None:
        """`most`: the units of one request by function."""
        self._store = store
        self._runs = runs_by_function(dialect)
        self._low_first = low_first
        self._most = most

    def answer(self, pdu: bytes) -> Answer:
        """Carries out a request. The reply to a broadcast is not sent."""
        function = pdu[0]
        try:
            return Answer(*self._serve(function, pdu))
        except Rejected as rejected:
            code = rejected.code
        except Denied as denied:
            code = _CODES.get(denied.why, _ILLEGAL_ADDRESS)
        return Answer(bytes((function | EXCEPTION, int(code, 16))), code)

    def _serve(self, function: int, pdu: bytes) -> tuple[bytes, str, Written]:
        """Raises `Rejected`, `Denied`."""
        runs = self._runs.get(function)
        if runs is None:
            raise Rejected(_ILLEGAL_FUNCTION)
        if function in _WRITES:
            wire, units = self._written(function, pdu)
            return pdu[:5], "", self._write(self._parts(runs, wire, len(units)), units)
        if len(pdu) != 5:
            raise Rejected(_ILLEGAL_VALUE)
        wire, count = unpack_from(">HH", pdu, 1)
        if not 1 <= count <= self._most[function]:
            raise Rejected(_ILLEGAL_VALUE)
        units = self._read(self._parts(runs, wire, count))
        return bytes((function,)) + _packed(function, units), "", ()

    def _parts(self, runs: Runs, wire: int, count: int) -> list[RunPiece]:
        parts = list(parts_of(runs, wire, count))
        if sum(part.size for part in parts) != count:
            raise Rejected(_ILLEGAL_ADDRESS)
        return parts

    def _read(self, parts: Sequence[RunPiece]) -> list[int]:
        units: list[int] = []
        for run, ahead, size in parts:
            if not run.halves:
                units += self._store.read(run.area, run.first + ahead, size)
                continue
            first, last = ahead // 2, (ahead + size - 1) // 2
            wide = self._store.read(run.area, run.first + first, last - first + 1)
            words = [half for unit in wide for half in self._halves(unit)]
            units += words[ahead % 2 :][:size]
        return units

    def _halves(self, unit: int) -> tuple[int, int]:
        low, high = unit & 0xFFFF, unit >> 16 & 0xFFFF
        return (low, high) if self._low_first else (high, low)

    def _write(self, parts: Sequence[RunPiece], units: Sequence[int]) -> Written:
        """Writes all parts as one. Raises `Denied`, and then nothing is written."""
        given = iter(units)
        cells: list[tuple[Cell, int]] = []
        missing: dict[Cell, int] = {}
        for part in parts:
            run, piece = part.run, [next(given) for _ in range(part.size)]
            if not run.halves:
                cells += [
                    ((run.area, run.first + n), one) for n, one in enumerate(piece, part.ahead)
                ]
                continue
            joined: dict[Cell, int] = {}
            for place, word in enumerate(piece, part.ahead):
                shift = 0 if (place % 2 == 0) is self._low_first else 16
                cell = (run.area, run.first + place // 2)
                joined[cell] = joined.get(cell, 0) | word << shift
                missing[cell] = missing.get(cell, 0xFFFF_FFFF) & ~(0xFFFF << shift)
            cells += joined.items()
        return self._store.write(cells, (), {cell: bits for cell, bits in missing.items() if bits})

    def _written(self, function: int, pdu: bytes) -> tuple[int, list[int]]:
        """Returns the wire address and the units of a write. Raises `Rejected` 03."""
        if len(pdu) < 5:
            raise Rejected(_ILLEGAL_VALUE)
        wire, second = unpack_from(">HH", pdu, 1)
        if function in WRITE_SINGLE:
            if len(pdu) != 5 or (function == 5 and second not in (0xFF00, 0)):
                raise Rejected(_ILLEGAL_VALUE)
            return wire, [int(second == 0xFF00) if function == 5 else second]
        size = (second + 7) // 8 if function == 15 else 2 * second
        if not 1 <= second <= self._most[function] or len(pdu) != 6 + size or pdu[5] != size:
            raise Rejected(_ILLEGAL_VALUE)
        if function == 15:
            return wire, [pdu[6 + i // 8] >> i % 8 & 1 for i in range(second)]
        return wire, list(unpack_from(f">{second}H", pdu, 6))


def _packed(function: int, units: Sequence[int]) -> bytes:
    """Returns byte count and data of a reply to a read."""
    if function in READ_WORDS:
        words = [unit & 0xFFFF for unit in units]
        return bytes((2 * len(units),)) + pack(f">{len(units)}H", *words)
    if function not in READ_BITS:
        raise AssertionError(f"function {function} reads nothing")
    data = bytearray((len(units) + 7) // 8)
    for place, bit in enumerate(units):
        data[place // 8] |= (bit & 1) << place % 8
    return bytes((len(data),)) + bytes(data)
