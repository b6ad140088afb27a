"""A simulated Modbus slave (application protocol V1.1b3, 6 and 7).

No reply to a wrong CRC or LRC, to frames of other stations and to broadcasts. Exceptions come in
the standard's order: 01 for the function, 03 for counts and values, 02 for the addresses.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadCoilsResponse,
    ReadDiscreteInputsRequest,
    ReadDiscreteInputsResponse,
    WriteMultipleCoilsRequest,
    WriteMultipleCoilsResponse,
    WriteSingleCoilRequest,
)
from pymodbus.pdu.exceptionresponse import ExceptionResponse
from pymodbus.pdu.pdu import ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
)

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
from gateway.stations.modbus.store import Store
from gateway.stations.station import Memory

Framing = Literal["rtu", "ascii", "tcp"]

_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_LOOPBACK = b"\x08\x00\x00"

_REQUESTS: dict[int, type[ModbusPDU]] = {
    1: ReadCoilsRequest,
    2: ReadDiscreteInputsRequest,
    3: ReadHoldingRegistersRequest,
    4: ReadInputRegistersRequest,
    5: WriteSingleCoilRequest,
    6: WriteSingleRegisterRequest,
    15: WriteMultipleCoilsRequest,
    16: WriteMultipleRegistersRequest,
}
_BIT_REPLIES: dict[int, type[ModbusPDU]] = {1: ReadCoilsResponse, 2: ReadDiscreteInputsResponse}
_WORD_REPLIES: dict[int, type[ModbusPDU]] = {
    3: ReadHoldingRegistersResponse,
    4: ReadInputRegistersResponse,
}
_MOST = {1: 2000, 2: 2000, 3: 125, 4: 125, 5: 1, 6: 1, 15: 1968, 16: 123}
# A K120S keeps ASCII frames to 128 characters.
_MOST_K120S_ASCII = {1: 464, 2: 464, 3: 29, 4: 29, 5: 1, 6: 1, 15: 432, 16: 27}


class _Malformed(Exception):
    """A request that contradicts itself."""


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
    _store: Store = field(init=False, repr=False)
    _codec: RtuSlaveCodec | AsciiCodec | MbapCodec = field(init=False, repr=False)
    _heard_at: float = field(init=False, default=0.0, repr=False)

    def __post_init__(self) -> None:
        low_first = self.counter_word_order == "low_first"
        self._store = Store(self.dialect, self.holes, low_first=low_first)
        self._codec = self._new_codec()

    @property
    def memory(self) -> Memory:
        return self._store.memory

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
        answers = [self._answer(frame, now) for frame in frames]
        return [self._codec.encode(answer) for answer in answers if answer is not None]

    def _new_codec(self) -> RtuSlaveCodec | AsciiCodec | MbapCodec:
        match self.framing:
            case "rtu":
                return RtuSlaveCodec(self.station)
            case "ascii":
                return AsciiCodec()
            case "tcp":
                return MbapCodec()

    def _answer(self, frame: Frame, now: float) -> Frame | None:
        to_all = frame.station == 0 and self.framing != "tcp" and self.dialect != "k120s"
        if not to_all and frame.station != self.station:
            return None
        answer = self._serve(frame.pdu, now)
        return None if to_all or not answer else Frame(frame.station, answer, frame.transaction)

    def _serve(self, pdu: bytes, now: float) -> bytes:
        """Returns the PDU of the reply to `pdu`; empty where `pdu` is no request."""
        function = pdu[0]
        if function >= 0x80:
            return b""
        if self.diagnostics and pdu.startswith(_LOOPBACK):
            return pdu
        if not self._store.serves(function):
            return _exception(function, _ILLEGAL_FUNCTION)
        try:
            request = self._decode(pdu)
        except (_Malformed, struct.error, ValueError):
            return _exception(function, _ILLEGAL_VALUE)
        count = _count(function, request)
        if not self._store.holds(function, request.address, count):
            return _exception(function, _ILLEGAL_ADDRESS)
        return self._do(function, request, count, now)

    def _decode(self, pdu: bytes) -> ModbusPDU:
        """Returns a consistent request. Raises the errors of pymodbus, or `_Malformed`."""
        function = pdu[0]
        request = _REQUESTS[function]()
        request.decode(pdu[1:])
        narrow = self.dialect == "k120s" and self.framing == "ascii"
        count = _count(function, request)
        if not 1 <= count <= (_MOST_K120S_ASCII if narrow else _MOST)[function]:
            raise _Malformed
        size = 5
        if function in (15, 16):
            data = (count + 7) // 8 if function == 15 else 2 * count
            size = 6 + data
            if pdu[5] != data:
                raise _Malformed
        if len(pdu) != size or (function == 5 and pdu[3:] not in (b"\xff\x00", b"\x00\x00")):
            raise _Malformed
        return request

    def _do(self, function: int, request: ModbusPDU, count: int, now: float) -> bytes:
        address = request.address
        match function:
            case 1 | 2:
                bits = [bool(bit) for bit in self._store.read(function, address, count, now)]
                return _encode(_BIT_REPLIES[function](bits=bits))
            case 3 | 4:
                words = [word & 0xFFFF for word in self._store.read(function, address, count, now)]
                return _encode(_WORD_REPLIES[function](registers=words))
            case 5 | 15:
                self._store.write(function, address, [int(bit) for bit in request.bits], now)
            case _:
                self._store.write(function, address, request.registers, now)
        match function:
            case 15:
                return _encode(WriteMultipleCoilsResponse(address=address, count=count))
            case 16:
                return _encode(WriteMultipleRegistersResponse(address=address, count=count))
        return _encode(request)  # the reply to 05 and 06 is equal to the request


def modbus_station(driver: ModbusRtu | ModbusAscii | ModbusTcp) -> ModbusStation:
    """Returns the station that the driver can talk to."""
    framings: dict[str, Framing] = {"modbus-ascii": "ascii", "modbus-tcp": "tcp"}
    return ModbusStation(
        station=driver.station,
        framing=framings.get(driver.protocol, "rtu"),
        dialect=driver.addressing,
        counter_word_order=driver.counter_word_order,
    )


def _count(function: int, request: ModbusPDU) -> int:
    return 1 if function in (5, 6) else request.count


def _encode(pdu: ModbusPDU) -> bytes:
    return bytes((pdu.function_code,)) + pdu.encode()


def _exception(function: int, code: int) -> bytes:
    return _encode(ExceptionResponse(function, code))
