"""The Modbus drivers: RTU, ASCII and TCP, each a list of settings over the same master."""

from collections.abc import Collection, Coroutine, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from gateway.errors import ConfigError
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.driver import Address, Area, Cost, Span, Talk, Timing, Traits
from gateway.protocols.listening import Ear, Learn
from gateway.protocols.modbus import ascii as ascii_
from gateway.protocols.modbus import mbap, rtu
from gateway.protocols.modbus.addressing import (
    EX485LNK,
    K120S,
    MODICON,
    PLAIN,
    VIGOR,
    Limits,
)
from gateway.protocols.modbus.ascii import AsciiCodec
from gateway.protocols.modbus.ear import MbapEar, Read, RtuEar, ascii_ear
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.master import Master
from gateway.protocols.modbus.mbap import MbapCodec
from gateway.protocols.modbus.rtu import RtuCodec
from gateway.values import Kind, Order

Addressing = Literal["plain", "vigor", "k120s", "ex485lnk"]
Numbering = Literal["zero_based", "modicon"]
WordOrder = Literal["low_first", "high_first"]

_DIALECTS = {"plain": PLAIN, "vigor": VIGOR, "k120s": K120S, "ex485lnk": EX485LNK}
_FASTEST_SILENCE = 0.00175  # seconds; above 19200 baud 3.5 characters would be shorter


# The begin of replies to short reads: function and number of bytes.
_READ_REPLIES = [
    *((function, 2 * words) for function in (3, 4) for words in range(1, 17)),
    *((function, count) for function in (1, 2) for count in range(1, 9)),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Modbus:
    """The settings that all kinds share."""

    protocol: str
    station: int
    addressing: Addressing = "plain"
    numbering: Numbering = "zero_based"  # plain only: how registers are written in the file
    write_single: bool = True  # one unit by function 05 or 06; false: by 15 or 16
    diagnostics: bool = False  # the device has function 08, sub-function 0
    counter_word_order: WordOrder = "low_first"  # of Vigor's C200 to C255
    max_read_words: int | None = None
    max_read_bits: int | None = None
    max_write_words: int | None = None
    max_write_bits: int | None = None
    _traits: ClassVar[Traits]
    _master: Master = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_master", _master(self))

    @property
    def traits(self) -> Traits:
        order = Order.HIGH_FIRST if self.addressing == "plain" else Order.LOW_FIRST
        return replace(self._traits, string_order=order)

    @property
    def areas(self) -> Mapping[str, Area]:
        return self._master.areas

    def address(self, text: str) -> Address:
        return self._master.dialect.address(text)

    def spell(self, address: Address) -> str:
        return self._master.dialect.spell(address)

    def named(self, table: str, number: int) -> str:
        return self._master.dialect.named(table, number)

    def cost(self, span: Span) -> Cost | None:
        return self._master.cost(span)

    def write_cost(self, span: Span) -> Cost | None:
        return self._master.write_cost(span)

    def read(self, talk: Talk[Frame], span: Span) -> Coroutine[Any, Any, Sequence[int]]:
        return self._master.read(talk, span)

    def write(
        self, talk: Talk[Frame], span: Span, units: Sequence[int]
    ) -> Coroutine[Any, Any, bool]:
        return self._master.write(talk, span, units)

    def changes_bits(self, span: Span) -> bool:
        return self._master.changes_bits(span)

    def change_bits(
        self, talk: Talk[Frame], span: Span, mask: int, bits: int
    ) -> Coroutine[Any, Any, bool]:
        return self._master.change_bits(talk, span, mask, bits)

    @property
    def identity_names(self) -> Collection[str]:
        return self._master.identity_names

    def identify(
        self, talk: Talk[Frame], names: Collection[str]
    ) -> Coroutine[Any, Any, Mapping[str, Sequence[str]]]:
        return self._master.identify(talk, names)

    def resync(
        self,
        talk: Talk[Frame],
        outstanding: Span | None,
        probe_token: int,
        spans: Sequence[Span] = (),
    ) -> Coroutine[Any, Any, int]:
        return self._master.resync(talk, outstanding, probe_token, spans)

    @property
    def framing(self) -> Hashable:
        return self.protocol

    def learn(self, read: Read, span: Span) -> Learn | None:
        return self._master.learn(read, span)

    @property
    def unnumbered(self) -> bool:
        return not self._master.numbered

    def reply_shape(self, span: Span) -> Hashable:
        return self._master.reply_shape(span)

    def write_shapes(self, span: Span, units: Sequence[int]) -> Sequence[Hashable]:
        return self._master.write_shapes(span, units)

    def resync_shape(
        self, outstanding: Span | None, probe_token: int, spans: Sequence[Span] = ()
    ) -> Hashable:
        return self._master.resync_shape(outstanding, probe_token, spans)

    def is_reply(self, frame: Frame) -> bool:
        return isinstance(frame, Frame) and frame.station == self.station


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusRtu(_Modbus):
    """Modbus RTU (serial line guide V1.02). Station 0 is a broadcast: written, never read."""

    protocol: Literal["modbus-rtu"] = "modbus-rtu"

    codec: ClassVar = RtuCodec
    scan_hints: ClassVar = ScanHints(formats=("8N1", "8E1", "8O1", "8N2"))
    dissector: ClassVar = "mbrtu"
    _traits: ClassVar = Traits(baudrate=9600, format="8E1", binary=True, word_type=Kind.UINT16)

    @property
    def timing(self) -> Timing:
        silence = max(_FASTEST_SILENCE, self._master.dialect.rtu_silence)
        return Timing(silence=silence, silence_chars=3.5)

    def ear(self, character: float) -> Ear:
        return RtuEar(character)

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return [bytes((self.station, *start)) for start in _READ_REPLIES]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusAscii(_Modbus):
    """Modbus ASCII (serial line guide V1.02). Station 0 is a broadcast: written, never read."""

    protocol: Literal["modbus-ascii"] = "modbus-ascii"

    codec: ClassVar = AsciiCodec
    scan_hints: ClassVar = ScanHints(formats=("7E1", "8N1", "7O1", "7N2"))
    _traits: ClassVar = Traits(baudrate=9600, format="7E1", word_type=Kind.UINT16)

    @property
    def timing(self) -> Timing:
        return Timing()

    def ear(self, character: float) -> Ear:
        return ascii_ear()

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return [b":%02X%02X%02X" % (self.station, *start) for start in _READ_REPLIES]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusTcp(_Modbus):
    """Modbus TCP (messaging guide V1.0b). `station` is the unit identifier; 0 is valid."""

    protocol: Literal["modbus-tcp"] = "modbus-tcp"
    station: int = 1
    window: int = 1  # the most outstanding requests that the device accepts

    codec: ClassVar = MbapCodec
    scan_hints: ClassVar = ScanHints(formats=())
    dissector: ClassVar = "mbtcp"
    _traits: ClassVar = Traits(baudrate=None, word_type=Kind.UINT16)

    @property
    def timing(self) -> Timing:
        return Timing(turnaround=0.001, silence=0.0)

    def ear(self, character: float) -> Ear:
        return MbapEar()


def _master(device: _Modbus) -> Master:
    """Checks the settings. Raises `ConfigError`."""
    dialect = _DIALECTS[device.addressing]
    if device.numbering == "modicon":
        if dialect is not PLAIN:
            raise ConfigError("numbering: modicon goes with addressing: plain only")
        dialect = MODICON
    stations, limits, chars = dialect.stations, dialect.limits, rtu.chars
    match device:
        case ModbusAscii():
            limits, chars = dialect.ascii_limits, ascii_.chars
        case ModbusTcp():
            chars = mbap.chars
            if dialect.any_unit:
                stations = range(256)
            if not 1 <= device.window <= 16:
                raise ConfigError(f"window {device.window} is not 1..16")
    if device.station not in stations:
        raise ConfigError(f"station {device.station} is not {stations[0]}..{stations[-1]}")
    return Master(
        station=device.station,
        chars=chars,
        dialect=dialect,
        limits=_limits(device, limits),
        write_single=device.write_single and dialect.single_writes,
        diagnostics=device.diagnostics,
        low_first=device.counter_word_order == "low_first",
        broadcast=device.station == 0 and not isinstance(device, ModbusTcp),
        numbered=isinstance(device, ModbusTcp),
    )


def _limits(device: _Modbus, usual: Limits) -> Limits:
    """Returns the limits of the file, and those of the dialect for those not in the file."""
    own = (
        device.max_read_words,
        device.max_read_bits,
        device.max_write_words,
        device.max_write_bits,
    )
    wanted = Limits(
        *(most if limit is None else limit for limit, most in zip(own, usual, strict=True))
    )
    for name, limit, most in zip(Limits._fields, wanted, Limits(), strict=True):
        if not 1 <= limit <= most:
            raise ConfigError(f"max_{name} {limit} is not 1..{most}")
    return wanted
