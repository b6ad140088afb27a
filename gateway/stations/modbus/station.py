"""A simulated Modbus slave.

No reply to a wrong CRC or LRC, to frames of other stations and to broadcasts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from gateway.errors import Garbled
from gateway.protocols.modbus import (
    AsciiCodec,
    Frame,
    MbapCodec,
    ModbusAscii,
    ModbusRtu,
    ModbusTcp,
    RtuSlaveCodec,
)
from gateway.protocols.modbus.frame import EXCEPTION
from gateway.stations.modbus.answers import MOST, ModbusData
from gateway.stations.modbus.dialects import K120sStore, memory_of
from gateway.stations.station import Memory, MemoryStore

Framing = Literal["rtu", "ascii", "tcp"]

_LOOPBACK = b"\x08\x00\x00"
# A K120S keeps ASCII frames to 128 characters.
_MOST_K120S_ASCII = {1: 464, 2: 464, 3: 29, 4: 29, 15: 432, 16: 27}


@dataclass(slots=True, kw_only=True)
class ModbusStation:
    """One slave on a line, or behind one TCP connection.

    `holes` are (area, first, last) that this device lacks: exception 02. `mute` is a station
    without its cable. `diagnostics`: it has function 08, sub-function 0. `gap` is the silence in
    seconds that discards half a request.
    """

    station: int = 1
    framing: Framing = "rtu"
    dialect: Literal["plain", "vigor", "k120s", "ex485lnk"] = "plain"
    counter_word_order: Literal["low_first", "high_first"] = "low_first"
    holes: Sequence[tuple[str, int, int]] = ()
    diagnostics: bool = True
    mute: bool = False
    gap: float = 0.1
    memory: Memory = field(init=False, repr=False)
    _store: MemoryStore | K120sStore = field(init=False, repr=False)
    _data: ModbusData = field(init=False, repr=False)
    _codec: RtuSlaveCodec | AsciiCodec | MbapCodec = field(init=False, repr=False)
    _heard_at: float = field(init=False, default=0.0, repr=False)

    def __post_init__(self) -> None:
        k120s = self.dialect == "k120s"
        holes = ((area, n) for area, first, last in self.holes for n in range(first, last + 1))
        self.memory = memory_of(self.dialect, holes)
        self._store = (K120sStore if k120s else MemoryStore)(self.memory)
        self._data = ModbusData(
            self._store,
            self.dialect,
            low_first=self.counter_word_order == "low_first",
            most=_MOST_K120S_ASCII if k120s and self.framing == "ascii" else MOST,
        )
        self._codec = self._new_codec()

    def hear(self, data: bytes, now: float) -> list[bytes]:
        """Returns the frames to send after `data`. With `tcp` the data of one connection."""
        if self.framing == "rtu" and now - self._heard_at > self.gap:
            self._codec = self._new_codec()
        self._heard_at = now
        if self.mute:
            return []
        try:
            frames = self._codec.feed(data)
        except Garbled:
            self._codec = self._new_codec()
            return []
        self._store.now = now
        answers = [self._answer(frame) for frame in frames]
        return [self._codec.encode(answer) for answer in answers if answer is not None]

    def _new_codec(self) -> RtuSlaveCodec | AsciiCodec | MbapCodec:
        match self.framing:
            case "rtu":
                return RtuSlaveCodec(self.station)
            case "ascii":
                return AsciiCodec()
            case "tcp":
                return MbapCodec()

    def _answer(self, frame: Frame) -> Frame | None:
        to_all = frame.station == 0 and self.framing != "tcp" and self.dialect != "k120s"
        if not to_all and frame.station != self.station:
            return None
        if frame.pdu[0] & EXCEPTION:
            return None
        if self.diagnostics and frame.pdu.startswith(_LOOPBACK):
            reply = frame.pdu
        else:
            reply = self._data.answer(frame.pdu).pdu
        return None if to_all else Frame(frame.station, reply, frame.transaction)


def modbus_station(driver: ModbusRtu | ModbusAscii | ModbusTcp) -> ModbusStation:
    """Returns the station that the driver can talk to."""
    framings: dict[str, Framing] = {"modbus-ascii": "ascii", "modbus-tcp": "tcp"}
    return ModbusStation(
        station=driver.station,
        framing=framings.get(driver.protocol, "rtu"),
        dialect=driver.addressing,
        counter_word_order=driver.counter_word_order,
    )
