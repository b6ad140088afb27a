"""What is customary where a protocol is spoken: the defaults that the file may leave out."""

from dataclasses import dataclass

from gateway.protocols.driver import AnyDriver, Unit
from gateway.values import Kind, Order, ValueType


@dataclass(frozen=True, slots=True)
class Custom:
    """A protocol's habits. `baudrate` None: it is spoken on a network, with no wire."""

    baudrate: int | None
    format: str
    word: Kind  # what a word holds unless the tag says otherwise
    eight_bits: bool = False  # its frames are binary: 7 data bits would cut them


_CUSTOMS = {
    "vigor": Custom(19200, "7E1", Kind.INT16),
    "computer-link": Custom(9600, "7E1", Kind.INT16),
    "modbus-rtu": Custom(9600, "8E1", Kind.UINT16, eight_bits=True),
    "modbus-ascii": Custom(9600, "7E1", Kind.UINT16),
    "frames": Custom(9600, "8N1", Kind.INT16),
    "modbus-tcp": Custom(None, "8N1", Kind.UINT16),
}


def custom(driver: AnyDriver) -> Custom:
    return _CUSTOMS[driver.protocol]


def default_type(driver: AnyDriver, unit: Unit) -> ValueType:
    """The type of an address that says nothing of its type."""
    match unit:
        case Unit.BIT:
            return ValueType(Kind.BOOL)
        case Unit.WORD:
            return ValueType(custom(driver).word)
        case Unit.DWORD:
            return ValueType(Kind.INT32)


def byte_order(driver: AnyDriver, kind: Kind) -> Order:
    """PLCs keep the first character of a text in the low byte; plain Modbus devices in the high."""
    plain_modbus = getattr(driver, "addressing", "") == "plain"
    if kind is Kind.STRING and not plain_modbus:
        return Order.LOW_FIRST
    return Order.HIGH_FIRST
