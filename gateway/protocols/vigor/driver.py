"""Reads and writes the devices of Vigor M, VB and VH PLCs over the computer link (manual B-5)."""

import re
import struct
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar, Literal

from gateway.errors import BadValue, ConfigError, Refusal, Refused
from gateway.protocols.byte_addresses import Cover, bits_from_bytes, bytes_from_bits
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.devices import parse_device, spell_device
from gateway.protocols.driver import Address, Cost, Span, Talk, Timing, Traits, Unit
from gateway.protocols.harmless import odd_reads, resync_by_reads
from gateway.protocols.listening import Learn, TrafficReader
from gateway.protocols.vigor.codec import (
    FORCE_OFF,
    FORCE_ON,
    GOOD,
    READ,
    SHORT_REPLY,
    WRITE,
    Frame,
    Reply,
    Request,
    VigorCodec,
)
from gateway.protocols.vigor.devices import AREAS, DEVICES, FORCIBLE, bit_address, cover
from gateway.protocols.vigor.traffic import vigor_traffic_reader

# Characters of a 51 request and of a 61 request without data; of a 70 or 71 request.
_BLOCK_REQUEST, _FORCE_REQUEST = 14, 12
_NO_COMMAND = "12"
_REFUSALS = {
    "10": (Refusal.DAMAGED, "ASCII conversion error, our request did not arrive whole"),
    "11": (Refusal.DAMAGED, "sum check error, our request did not arrive whole"),
    _NO_COMMAND: (Refusal.OTHER, "no such command"),
    "14": (Refusal.DAMAGED, "stop bit, parity, frame or overrun error: line settings or noise"),
    "28": (Refusal.ADDRESS, "data address out of range"),
}
_TRAITS = Traits(baudrate=19200, format="7E1", one_format=True)
_FORMAT = re.compile(r"[78][NEO][12]\Z")


@dataclass(frozen=True, slots=True, kw_only=True)
class Vigor:
    """One Vigor PLC. `station` is 0 on port CP1, 0..255 on CP2, 0..99 on CP3.

    `format`: only for a device that is set to another format than the manual's.
    """

    protocol: Literal["vigor"] = "vigor"
    station: int = 0
    format: str = _TRAITS.format

    codec: ClassVar = VigorCodec
    areas: ClassVar = AREAS
    timing: ClassVar = Timing(silence=0.005, learn_silence=True)
    scan_hints: ClassVar = ScanHints(formats=("7E1", "8N1"), stations=range(32))
    unnumbered: ClassVar = True

    def __post_init__(self) -> None:
        if not 0 <= self.station <= 255:
            raise ConfigError(f"station {self.station} is not 0..255")
        if not _FORMAT.match(self.format):
            raise ConfigError(f"format: {self.format} is no character format such as 8N1")

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return (b"\x06%02X%s00" % (self.station, READ.encode()),)

    @property
    def traits(self) -> Traits:
        usual = self.format == _TRAITS.format
        return _TRAITS if usual else replace(_TRAITS, format=self.format)

    def address(self, text: str) -> Address:
        """Parses `X17` and `Y20` (octal), `M12`, `S5`, `D100`, `D7.3`, `M9003`, `D9001`; timers
        and counters: `T5` the value, `TS5` the contact, `TC5` the coil. Raises `ConfigError`."""
        return parse_device(text, DEVICES)

    def spell(self, address: Address) -> str:
        return spell_device(address, DEVICES)

    def cost(self, span: Span) -> Cost | None:
        """The cost of one 51: whole bytes, 128 at most."""
        covered = cover(span)
        return None if covered is None else _read_cost(covered)

    def write_cost(self, span: Span) -> Cost | None:
        """The cost of one 70, 71 or 61; of a 51 and a 61 for bits that do not fill their bytes."""
        covered = cover(span)
        if covered is None:
            return None
        if _forced(span):
            return Cost(_FORCE_REQUEST, SHORT_REPLY)
        write = Cost(_BLOCK_REQUEST + 2 * covered.size, SHORT_REPLY)
        return covered.write_cost(_read_cost(covered), write)

    async def read(self, talk: Talk[Frame], span: Span) -> Sequence[int]:
        """Returns the units of `span`. Raises `ConfigError` for a span without `cost`."""
        covered = cover(span)
        if covered is None:
            raise ConfigError(f"{span.size} of {span.area} from {span.start}: not in one request")
        data = await self._read_bytes(talk, covered.address, covered.size)
        unit = AREAS[span.area].unit  # as `_units`, which would be one more call for each poll
        if unit is Unit.BIT:
            return bits_from_bytes(data)[covered.ahead : covered.ahead + span.size]
        form = f"<{len(data) // 4}I" if unit is Unit.DWORD else f"<{len(data) // 2}H"
        return struct.unpack(form, data)  # low byte first

    async def write(self, talk: Talk[Frame], span: Span, units: Sequence[int]) -> bool:
        """Writes, and waits for the acknowledgement.

        A single bit is forced where the area permits it. Other bits are written in whole bytes:
        their neighbours are read just before, and written back.
        """
        covered = cover(span)
        if covered is None or len(units) != span.size:
            raise BadValue(f"{len(units)} values for {span.size} of {span.area} from {span.start}")
        unit = AREAS[span.area].unit
        if not all(0 <= value <= unit.largest for value in units):
            raise BadValue(f"a {unit} holds 0..{unit.largest}")
        if _forced(span):
            command = FORCE_ON if units[0] else FORCE_OFF
            body = b"%04X" % bit_address(span.area, span.start)
            await self._write_body(talk, command, body)
            return True
        if unit is Unit.BIT:
            data = bytes_from_bits(await self._with_neighbours(talk, covered, units))
        else:
            form = f"<{len(units)}{'I' if unit is Unit.DWORD else 'H'}"
            data = struct.pack(form, *units)
        body = b"%04X%02X" % (covered.address, covered.size) + data.hex().upper().encode("ascii")
        await self._write_body(talk, WRITE, body)
        return True

    def writes_around(self, span: Span) -> bool:
        """True for bits that do not fill their bytes, except a single one that can be forced."""
        covered = cover(span)
        return covered is not None and bool(covered.ahead or covered.behind) and not _forced(span)

    async def resync(
        self,
        talk: Talk[Frame],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Reads M0 and up, in a number of bytes that no outstanding request reads.

        Every second resync reads inside the `spans`, if they allow it: a device that only speaks
        this protocol may lack M0 and be silent about it. An error reply names no request: it may
        be the late reply to the `outstanding` read, so one more read with another number of bytes
        follows, in the other place.
        """
        pick = odd_reads("M", outstanding, spans, _bytes)
        return await resync_by_reads(
            lambda span: self.read(talk, span), probe_token, outstanding, pick, _bytes
        )

    # Listening to another master

    @property
    def framing(self) -> Hashable:
        return self.protocol

    def traffic_reader(self, character: float) -> TrafficReader:
        return vigor_traffic_reader()

    def learn(self, read: tuple[int, int], span: Span) -> Learn | None:
        """`read`: address and number of the bytes."""
        covered, (address, count) = cover(span), read
        if covered is None or covered.address < address:
            return None
        begin = covered.address - address
        end = begin + covered.size
        return None if end > count else lambda data: _units(data[begin:end], span, covered)

    # The shapes of replies

    def reply_shape(self, span: Span) -> Hashable:
        """The number of bytes: a reply names station and command, but no address."""
        covered = cover(span)
        return None if covered is None else covered.size

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        """The command. Bits that do not fill their bytes are read just before."""
        if _forced(span):
            return (FORCE_ON if units[0] else FORCE_OFF,)
        covered = cover(span)
        neighbours = covered is not None and (covered.ahead or covered.behind)
        return (self.reply_shape(span), WRITE) if neighbours else (WRITE,)

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        return _bytes(odd_reads("M", outstanding, spans, _bytes)(probe_token))

    def is_reply(self, frame: Frame) -> bool:
        return isinstance(frame, Reply) and frame.station == self.station

    async def _read_bytes(self, talk: Talk[Frame], address: int, count: int) -> bytes:
        request = _read_request(self.station, address, count)
        return await talk.ask(request, SHORT_REPLY + 2 * count, _answers(self.station, READ, count))

    async def _write_body(self, talk: Talk[Frame], command: str, body: bytes) -> None:
        request = Request(self.station, command, body)
        await talk.ask(request, SHORT_REPLY, _answers(self.station, command, 0))

    async def _with_neighbours(
        self, talk: Talk[Frame], covered: Cover, units: Sequence[int]
    ) -> Sequence[int]:
        """Returns the bits of whole bytes."""
        if not covered.ahead and not covered.behind:
            return units
        bits = bits_from_bytes(await self._read_bytes(talk, covered.address, covered.size))
        bits[covered.ahead : len(bits) - covered.behind] = units
        return bits


def _units(data: bytes, span: Span, covered: Cover) -> Sequence[int]:
    """Returns the units of `span`, of its bytes."""
    unit = AREAS[span.area].unit
    if unit is Unit.BIT:
        return bits_from_bytes(data)[covered.ahead : covered.ahead + span.size]
    form = f"<{len(data) // 4}I" if unit is Unit.DWORD else f"<{len(data) // 2}H"
    return struct.unpack(form, data)  # low byte first


def _bytes(span: Span) -> int | None:
    covered = cover(span)
    return None if covered is None else covered.size


def _forced(span: Span) -> bool:
    return span.size == 1 and span.area in FORCIBLE


def _read_cost(covered: Cover) -> Cost:
    return Cost(_BLOCK_REQUEST, SHORT_REPLY + 2 * covered.size)


@lru_cache(maxsize=4096)
def _read_request(station: int, address: int, count: int) -> Request:
    return Request(station, READ, b"%04X%02X" % (address, count))


@lru_cache(maxsize=1024)
def _answers(station: int, command: str, count: int) -> Callable[[Frame], bytes | None]:
    """Returns the acceptance of a reply: its `count` bytes of data, or its error code."""

    def answers(frame: Frame) -> bytes | None:
        if not isinstance(frame, Reply) or frame.station != station or frame.command != command:
            return None
        if frame.status == GOOD:
            return frame.data if len(frame.data) == count else None
        if frame.data:
            return None
        refusal, meaning = _REFUSALS.get(frame.status, (Refusal.OTHER, "a code unknown to us"))
        raise Refused(
            f"station {station} answers {frame.status} to command {command}: {meaning}",
            code=frame.status,
            refusal=refusal,
            unexecuted=refusal is Refusal.DAMAGED or frame.status == _NO_COMMAND,
        )

    return answers
