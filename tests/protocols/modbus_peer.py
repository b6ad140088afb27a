"""A Modbus device with given replies; and pymodbus' view of frames."""

from collections.abc import Callable, Sequence

from pymodbus.framer import FramerAscii, FramerBase, FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from tests.doubles import Wire

KINDS = (ModbusRtu, ModbusAscii, ModbusTcp)
Driver = ModbusRtu | ModbusAscii | ModbusTcp
FRAMERS: dict[type, type[FramerBase]] = {
    ModbusRtu: FramerRTU,
    ModbusAscii: FramerAscii,
    ModbusTcp: FramerSocket,
}


def hearing(driver: Driver, *heard: Sequence[bytes] | Callable[[bytes], Sequence[bytes]]) -> Wire:
    """A wire on which the n-th item of `heard` comes back after the n-th request.

    An item may be a function of the bytes of the request.
    """
    items = iter(heard)

    def respond(request: bytes) -> Sequence[bytes]:
        pieces = next(items, [])
        return pieces(request) if callable(pieces) else pieces

    return Wire(driver, respond)


def oracle_decodes(kind: type, data: bytes, station: int, *, requests: bool) -> ModbusPDU:
    """Returns the message that pymodbus decodes from one frame."""
    used, pdu = FRAMERS[kind](DecodePDU(requests)).handleFrame(data, station, 0)
    assert used == len(data)
    assert pdu is not None
    return pdu


def oracle_encodes(kind: type, pdu: ModbusPDU) -> bytes:
    return FRAMERS[kind](DecodePDU(True)).buildFrame(pdu)
