"""Reads and writes the devices of one Mitsubishi FX at its programming port."""

import struct
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from gateway.errors import BadValue, ConfigError, Refusal, Refused
from gateway.protocols.byte_addresses import Cover, bits_from_bytes, bytes_from_bits
from gateway.protocols.devices import parse_device, spell_device
from gateway.protocols.driver import Address, Cost, Span, Talk, Timing, Traits, Unit
from gateway.protocols.fx.codec import (
    AROUND,
    FORCE_OFF,
    FORCE_ON,
    READ,
    WRITE,
    Frame,
    FxCodec,
    Reply,
    Request,
)
from gateway.protocols.fx.devices import AREAS, DEVICES, bit_address, cover
from gateway.protocols.harmless import odd_reads, resync_by_reads

_REQUEST = AROUND + 7  # command, address and number of bytes
_ACKNOWLEDGED: Hashable = "ack"
_FORCE_COST = Cost(AROUND + 5, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fx:
    """One FX. The port has no station numbers: one PLC is on the line."""

    protocol: Literal["fx"] = "fx"

    station: ClassVar = 0
    codec: ClassVar = FxCodec
    areas: ClassVar = AREAS
    timing: ClassVar = Timing(turnaround=0.02, silence=0.005)
    traits: ClassVar = Traits(
        baudrate=9600, format="7E1", one_format=True, numbered=False, alone=True
    )
    unnumbered: ClassVar = True

    def address(self, text: str) -> Address:
        """Parses `X17` and `Y20` (octal), `M12`, `M8000`, `S5`, `D100`, `D7.3`, `D8001`; timers and
        counters: `T5` the value, `TS5` the contact. Raises `ConfigError`."""
        return parse_device(text, DEVICES)

    def spell(self, address: Address) -> str:
        return spell_device(address, DEVICES)

    def cost(self, span: Span) -> Cost | None:
        """The cost of one read: whole bytes, 64 at most."""
        covered = cover(span)
        return None if covered is None else _read_cost(covered)

    def write_cost(self, span: Span) -> Cost | None:
        """The cost of one write; also of a read for bits that do not fill their bytes."""
        covered = cover(span)
        if covered is None:
            return None
        if _forced(span):
            return _FORCE_COST
        return covered.write_cost(_read_cost(covered), Cost(_REQUEST + 2 * covered.size, 1))

    async def read(self, talk: Talk[Frame], span: Span) -> Sequence[int]:
        """Returns the units of `span`. Raises `ConfigError` for a span without `cost`."""
        covered = cover(span)
        if covered is None:
            raise ConfigError(f"{span.size} of {span.area} from {span.start}: not in one request")
        data = await self._read_bytes(talk, covered)
        if AREAS[span.area].unit is Unit.BIT:
            return bits_from_bytes(data)[covered.ahead : covered.ahead + span.size]
        return struct.unpack(_form(span), data)

    async def write(self, talk: Talk[Frame], span: Span, units: Sequence[int]) -> bool:
        """Writes, and waits for the acknowledgement. A single bit is forced; other bits are written
        in whole bytes: their neighbours are read just before, and written back."""
        covered, unit = cover(span), AREAS[span.area].unit
        if covered is None or len(units) != span.size:
            raise BadValue(f"{len(units)} values for {span.size} of {span.area} from {span.start}")
        if not all(0 <= value <= unit.largest for value in units):
            raise BadValue(f"a {unit} holds 0..{unit.largest}")
        if _forced(span):
            command = FORCE_ON if units[0] else FORCE_OFF
            await talk.ask(Request(command, bit_address(span)), 1, _acknowledged)
            return True
        if unit is Unit.BIT:
            if covered.ahead or covered.behind:
                bits = bits_from_bytes(await self._read_bytes(talk, covered))
                bits[covered.ahead : len(bits) - covered.behind] = units
                units = bits
            data = bytes_from_bits(units)
        else:
            data = struct.pack(_form(span), *units)
        body = b"%04X%02X" % (covered.address, covered.size) + data.hex().upper().encode("ascii")
        await talk.ask(Request(WRITE, body), 1, _acknowledged)
        return True

    def writes_around(self, span: Span) -> bool:
        """True for several bits that do not fill their bytes."""
        covered = cover(span)
        return covered is not None and bool(covered.ahead or covered.behind) and not _forced(span)

    async def resync(
        self,
        talk: Talk[Frame],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> int:
        """Reads M0 and up, or inside the `spans`, in a number of bytes that no outstanding request
        reads: a reply names neither command nor address."""
        pick = odd_reads("M", outstanding, spans, self.reply_shape)
        return await resync_by_reads(
            lambda span: self.read(talk, span), probe_token, outstanding, pick, self.reply_shape
        )

    # The shapes of replies

    def reply_shape(self, span: Span) -> Hashable:
        """The number of bytes."""
        covered = cover(span)
        return None if covered is None else covered.size

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        if self.writes_around(span):
            return (self.reply_shape(span), _ACKNOWLEDGED)
        return (_ACKNOWLEDGED,)

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        pick = odd_reads("M", outstanding, spans, self.reply_shape)
        return self.reply_shape(pick(probe_token))

    def is_reply(self, frame: Frame) -> bool:
        return isinstance(frame, Reply)

    async def _read_bytes(self, talk: Talk[Frame], covered: Cover) -> bytes:
        request = Request(READ, b"%04X%02X" % (covered.address, covered.size))
        return await talk.ask(request, AROUND + 2 * covered.size, _data(covered.size))


def _form(span: Span) -> str:
    """Low byte first."""
    return f"<{span.size}{'I' if AREAS[span.area].unit is Unit.DWORD else 'H'}"


def _forced(span: Span) -> bool:
    return span.size == 1 and AREAS[span.area].unit is Unit.BIT


def _read_cost(covered: Cover) -> Cost:
    return Cost(_REQUEST, AROUND + 2 * covered.size)


def _checked(frame: Frame) -> bytes | None:
    """Returns the data of a reply; None: it is an acknowledgement. Raises `Refused`."""
    if isinstance(frame, Reply) and frame.refused:
        raise Refused(
            "the PLC refuses the request (NAK): it lacks the address, or the request was damaged",
            code="NAK",
            refusal=Refusal.ADDRESS,
            unexecuted=True,
        )
    return frame.data if isinstance(frame, Reply) else None


def _acknowledged(frame: Frame) -> bool | None:
    return None if _checked(frame) is not None else True


def _data(size: int) -> Callable[[Frame], bytes | None]:
    """Returns the acceptance of a reply with so many bytes."""

    def data(frame: Frame) -> bytes | None:
        found = _checked(frame)
        return found if found is not None and len(found) == size else None

    return data
