"""The devices of a Vigor PLC and their byte addresses (manual B-5-3)."""

from gateway.protocols.byte_addresses import covering
from gateway.protocols.devices import device_table
from gateway.protocols.driver import Area, Unit
from gateway.protocols.vigor.codec import MOST_BYTES

# Area, and the byte address of its first device.
_PLACES = (
    (Area("X", Unit.BIT, 0, 0o777, octal=True), 0x0000),
    (Area("Y", Unit.BIT, 0, 0o777, octal=True), 0x0040),
    (Area("M", Unit.BIT, 0, 5119), 0x0080),
    (Area("S", Unit.BIT, 0, 999), 0x0300),
    (Area("TS", Unit.BIT, 0, 255), 0x0380),
    (Area("CS", Unit.BIT, 0, 255), 0x03A0),
    (Area("M9", Unit.BIT, 9000, 9255), 0x03E0),
    (Area("TC", Unit.BIT, 0, 255), 0x0780),
    (Area("CC", Unit.BIT, 0, 255), 0x07A0),
    (Area("T", Unit.WORD, 0, 255), 0x1400),
    (Area("D9", Unit.WORD, 9000, 9255), 0x1600),
    (Area("C", Unit.WORD, 0, 199), 0x1800),
    (Area("C32", Unit.DWORD, 200, 255), 0x1A00),
    (Area("D", Unit.WORD, 0, 8191), 0x1C00),
)
AREAS = {area.name: area for area, _ in _PLACES}
_BASES = {area.name: base for area, base in _PLACES}

# The areas for 70 and 71 in the manual; bits of T and C can only be written as whole bytes.
FORCIBLE = frozenset({"X", "Y", "M", "S", "M9"})

# M and D continue at 9000, after a gap.
DEVICES = device_table(AREAS.values(), TN="T", CN="C")
cover = covering(_PLACES, MOST_BYTES)


def bit_address(area: str, number: int) -> int:
    """Returns the address of a bit for 70 and 71: byte address times eight, plus its place."""
    return 8 * _BASES[area] + number - AREAS[area].first
