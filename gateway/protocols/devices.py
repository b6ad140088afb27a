"""Parses PLC device addresses as their makers write them: `D100`, `X17` (octal), `D7.3`.

A table lists the letters of a device and their areas, which differ by number: Vigor's `C` is a
16-bit word up to C199 and a 32-bit one from C200 on.
"""

import re
from collections.abc import Iterable, Mapping, Sequence

from gateway.errors import ConfigError
from gateway.protocols.driver import Address, Area, Unit

# Letters -> areas. Where several letters name one area, the first is the one it is spelled with.
DeviceTable = Mapping[str, Sequence[Area]]


def device_table(areas: Iterable[Area], **also: str) -> DeviceTable:
    """Returns the letters of the areas: those of `M9` are M. `also`: other letters of the same."""
    table: dict[str, list[Area]] = {}
    for area in areas:
        table.setdefault(area.name.rstrip("0123456789"), []).append(area)
    return table | {letters: table[same] for letters, same in also.items()}


# Nine digits are more than any device has, and fewer than `int` refuses.
_DEVICE = re.compile(r"([A-Za-z]+)([0-9]{1,9})(?:\.([0-9]{1,9}))?")


def parse_device(text: str, table: DeviceTable) -> Address:
    """Parses an address. Either case and leading zeros are accepted.

    Numbers of octal areas become plain integers: X17 is number 15.
    Raises `ConfigError` with a correct example.
    """
    match = _DEVICE.fullmatch(text)
    if match is None:
        raise ConfigError(
            f"{text!r} is no device address: write it as D100, a bit of a word as D100.3"
        )
    letters = match[1].upper()
    areas = table.get(letters)
    if areas is None:
        raise ConfigError(f"{text}: there is no device {letters}; there are {', '.join(table)}")
    number = _number(text, match[2], areas[0], table)
    area = next((area for area in areas if area.first <= number <= area.last), None)
    if area is None:
        raise ConfigError(f"{text}: {letters} goes from {_ranges(letters, areas)}")
    bit = None if match[3] is None else _bit(text, int(match[3]), area)
    return Address(area.name, number, bit)


def spell_device(address: Address, table: DeviceTable) -> str:
    """Writes an address as its maker does: the inverse of `parse_device`."""
    for letters, areas in table.items():
        for area in areas:
            if area.name == address.area:
                bit = "" if address.bit is None else f".{address.bit}"
                return f"{letters}{_digits(address.number, area)}{bit}"
    raise ConfigError(f"there is no area {address.area}")


def _number(text: str, digits: str, area: Area, table: DeviceTable) -> int:
    if not area.octal:
        return int(digits)
    if "8" in digits or "9" in digits:
        octal = [letters for letters, areas in table.items() if areas[0].octal]
        are = "are" if len(octal) > 1 else "is"
        raise ConfigError(
            f"{text}: {' and '.join(octal)} {are} numbered in octal, 8 and 9 do not exist"
        )
    return int(digits, 8)


def _bit(text: str, bit: int, area: Area) -> int:
    whole = text.partition(".")[0]
    match area.unit:
        case Unit.BIT:
            raise ConfigError(f"{text}: {whole} is a bit already, write {whole}")
        case Unit.DWORD:
            raise ConfigError(f"{text}: {whole} is 32 bits wide, only 16-bit words have bits")
        case Unit.WORD if bit > 15:
            raise ConfigError(f"{text}: the bits of a word are .0 to .15")
    return bit


def _digits(number: int, area: Area) -> str:
    return f"{number:o}" if area.octal else str(number)


def _ranges(letters: str, areas: Sequence[Area]) -> str:
    """Returns `D0 to D8191 and D9000 to D9255`; adjacent areas are joined."""
    runs: list[tuple[int, int]] = []
    for area in sorted(areas, key=lambda area: area.first):
        if runs and runs[-1][1] + 1 == area.first:
            runs[-1] = (runs[-1][0], area.last)
        else:
            runs.append((area.first, area.last))
    return " and ".join(
        f"{letters}{_digits(first, areas[0])} to {letters}{_digits(last, areas[0])}"
        for first, last in runs
    )
