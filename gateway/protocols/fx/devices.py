"""The devices of an FX and their byte addresses for the commands 0, 1, 7 and 8."""

from gateway.protocols.byte_addresses import covering
from gateway.protocols.devices import device_table
from gateway.protocols.driver import Area, Span, Unit
from gateway.protocols.fx.codec import MOST_BYTES

# Area, and the byte address of its first device.
_PLACES = (
    (Area("S", Unit.BIT, 0, 999), 0x0000),
    (Area("X", Unit.BIT, 0, 0o377, octal=True), 0x0080),
    (Area("Y", Unit.BIT, 0, 0o377, octal=True), 0x00A0),
    (Area("TS", Unit.BIT, 0, 255), 0x00C0),
    (Area("M", Unit.BIT, 0, 1023), 0x0100),
    (Area("CS", Unit.BIT, 0, 255), 0x01C0),
    (Area("M8", Unit.BIT, 8000, 8255), 0x01E0),
    (Area("T", Unit.WORD, 0, 255), 0x0800),
    (Area("C", Unit.WORD, 0, 199), 0x0A00),
    (Area("C32", Unit.DWORD, 200, 255), 0x0C00),
    (Area("D8", Unit.WORD, 8000, 8255), 0x0E00),
    (Area("D", Unit.WORD, 0, 1023), 0x1000),
)
AREAS = {area.name: area for area, _ in _PLACES}
_BASES = {area.name: base for area, base in _PLACES}
DEVICES = device_table(AREAS.values(), TN="T", CN="C")
cover = covering(_PLACES, MOST_BYTES)


def bit_address(span: Span) -> bytes:
    """Returns the address of a bit for 7 and 8: its place in all bits, low byte first, in hex."""
    place = 8 * _BASES[span.area] + span.start - AREAS[span.area].first
    return place.to_bytes(2, "little").hex().upper().encode("ascii")
