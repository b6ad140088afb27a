"""A tag of one unit of a device, with the value that the device has in it."""

from gateway.protocols.driver import Address, Addressing, Span, Unit
from gateway.tags.tag import Tag
from gateway.values import Kind, Layout, ValueType

_TYPES = {Unit.BIT: Kind.BOOL, Unit.WORD: Kind.UINT16, Unit.DWORD: Kind.UINT32}


def unit_tag(device: str, driver: Addressing, address: Address, name: str, every: float) -> Tag:
    """`address`: of an area of the driver."""
    unit = driver.areas[address.area].unit
    return Tag(
        device=device,
        name=name,
        text=driver.spell(address),
        address=address,
        span=Span(address.area, address.number, 1),
        unit_kind=unit,
        layout=Layout(ValueType(_TYPES[unit])),
        every=every,
    )
