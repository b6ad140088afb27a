"""The Modbus drivers: RTU, ASCII and TCP, each a list of settings over the same master."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from gateway.errors import ConfigError
from gateway.protocols.capabilities import ScanHints
from gateway.protocols.driver import Timing, Traits
from gateway.protocols.listening import TrafficReader
from gateway.protocols.modbus import ascii as ascii_
from gateway.protocols.modbus import mbap, rtu
from gateway.protocols.modbus.addressing import Dialect, Limits
from gateway.protocols.modbus.frame import Frame
from gateway.protocols.modbus.master import Master
from gateway.protocols.modbus.pdu import is_absence
from gateway.protocols.modbus.traffic import (
    MbapTrafficReader,
    RtuTrafficReader,
    ascii_traffic_reader,
)
from gateway.values import Kind

_FASTEST_SILENCE = 0.00175  # seconds; above 19200 baud 3.5 characters would be shorter

# The begin of replies to short reads: function and number of bytes.
_READ_REPLIES = [
    *((function, 2 * words) for function in (3, 4) for words in range(1, 17)),
    *((function, count) for function in (1, 2) for count in range(1, 9)),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusRtu(Master):
    """Modbus RTU (serial line guide V1.02). Station 0 is a broadcast: written, never read."""

    protocol: Literal["modbus-rtu"] = "modbus-rtu"

    codec: ClassVar = rtu.RtuCodec
    scan_hints: ClassVar = ScanHints(formats=("8N1", "8E1", "8O1", "8N2"))
    _traits: ClassVar = Traits(
        baudrate=9600, format="8E1", binary=True, word_type=Kind.UINT16, dissector="mbrtu"
    )

    @property
    def timing(self) -> Timing:
        silence = max(_FASTEST_SILENCE, self.dialect.rtu_silence)
        return Timing(silence=silence, silence_chars=3.5)

    def chars(self, pdu_length: int) -> int:
        return rtu.chars(pdu_length)

    def traffic_reader(self, character: float) -> TrafficReader:
        return RtuTrafficReader(character)

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return [bytes((self.station, *start)) for start in _READ_REPLIES]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusAscii(Master):
    """Modbus ASCII (serial line guide V1.02). Station 0 is a broadcast: written, never read."""

    protocol: Literal["modbus-ascii"] = "modbus-ascii"

    codec: ClassVar = ascii_.AsciiCodec
    scan_hints: ClassVar = ScanHints(formats=("7E1", "8N1", "7O1", "7N2"))
    timing: ClassVar = Timing()
    _traits: ClassVar = Traits(baudrate=9600, format="7E1", word_type=Kind.UINT16)

    def _allowed(self, dialect: Dialect) -> tuple[range, Limits]:
        return dialect.stations, dialect.ascii_limits

    def chars(self, pdu_length: int) -> int:
        return ascii_.chars(pdu_length)

    def traffic_reader(self, character: float) -> TrafficReader:
        return ascii_traffic_reader()

    @property
    def reply_starts(self) -> Sequence[bytes]:
        return [b":%02X%02X%02X" % (self.station, *start) for start in _READ_REPLIES]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModbusTcp(Master):
    """Modbus TCP (messaging guide V1.0b). `station` is the unit identifier; 0 is valid."""

    protocol: Literal["modbus-tcp"] = "modbus-tcp"
    station: int = 1
    window: int = 1  # the most outstanding requests that the device accepts

    codec: ClassVar = mbap.MbapCodec
    scan_hints: ClassVar = ScanHints(formats=())
    timing: ClassVar = Timing(turnaround=0.001, silence=0.0)
    numbered: ClassVar = True
    _traits: ClassVar = Traits(baudrate=None, word_type=Kind.UINT16, dissector="mbtcp")

    def _allowed(self, dialect: Dialect) -> tuple[range, Limits]:
        if not 1 <= self.window <= 16:
            raise ConfigError(f"window {self.window} is not 1..16")
        return range(256) if dialect.any_unit else dialect.stations, dialect.limits

    def chars(self, pdu_length: int) -> int:
        return mbap.chars(pdu_length)

    def traffic_reader(self, character: float) -> TrafficReader:
        return MbapTrafficReader()

    def is_absence(self, frame: Frame) -> bool:
        return is_absence(frame.pdu)
