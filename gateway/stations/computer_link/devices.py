"""The devices of a simulated Computer Link PLC: tables, five-character names, data characters.

Liyan manual 1-5, 1-6 and chapter 2; Mitsubishi's after JY992D69901.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from gateway.stations.store import Rejected

Profile = Literal["liyan", "ex1s", "ex1n", "ex2n", "fx"]

# profile: (last X and Y, last M, last D)
_LAST = {
    "liyan": (0o177, 1535, 3999),
    "ex1s": (0o17, 1535, 3999),
    "ex1n": (0o177, 1535, 3999),
    "ex2n": (0o177, 1535, 3999),
    "fx": (0o267, 3071, 7999),
}
_BIT_AREAS = ("X", "Y", "M", "M8", "S")
_CONTACTS = ("TS", "CS")
_NAME = re.compile(r"([XY])([0-7]{4})|([MSD])([0-9]{4})|(TS|CS|TN|CN)([0-9]{3})")


class Kind(StrEnum):
    """The counting and writing of devices in a request."""

    BITS = "bits"
    SIXTEENS = "sixteens"  # bit devices in words
    WORDS = "words"
    DWORDS = "dwords"


_DIGITS = {Kind.BITS: 1, Kind.SIXTEENS: 4, Kind.WORDS: 4, Kind.DWORDS: 8}


@dataclass(frozen=True, slots=True)
class Limits:
    """The most a command takes; of the batch commands by kind of device."""

    read: dict[Kind, int]
    write: dict[Kind, int]
    loopback: int
    monitored: int
    scattered_bits: int = 20
    scattered_words: int = 10


_LIYAN = Limits(
    read={Kind.BITS: 64, Kind.SIXTEENS: 64, Kind.WORDS: 64, Kind.DWORDS: 16},
    write={Kind.BITS: 64, Kind.SIXTEENS: 8, Kind.WORDS: 64, Kind.DWORDS: 16},
    loopback=128,
    monitored=10,
)
_FX = Limits(
    read={Kind.BITS: 256, Kind.SIXTEENS: 32, Kind.WORDS: 64, Kind.DWORDS: 32},
    write={Kind.BITS: 160, Kind.SIXTEENS: 10, Kind.WORDS: 64, Kind.DWORDS: 32},
    loopback=254,
    monitored=0,
)


def limits(profile: Profile) -> Limits:
    return _FX if profile == "fx" else _LIYAN


def areas(profile: Profile) -> list[tuple[str, int, int]]:
    """Returns (area, first, last) of all devices of this profile."""
    last_xy, last_m, last_d = _LAST[profile]
    return [
        ("X", 0, last_xy),
        ("Y", 0, last_xy),
        ("M", 0, last_m),
        ("M8", 8000, 8255),
        ("S", 0, 999),
        ("TS", 0, 255),
        ("CS", 0, 255),
        ("T", 0, 255),
        ("C", 0, 199),
        ("C32", 200, 255),
        ("D", 0, last_d),
        ("D8", 8000, 8255),
    ]


@dataclass(frozen=True, slots=True)
class Cells:
    """Neighbouring devices that a request names; `size` counts points where they are bits."""

    area: str
    first: int
    size: int
    kind: Kind

    def __iter__(self) -> Iterator[tuple[str, int]]:
        for number in range(self.first, self.first + self.size):
            yield self.area, number

    @property
    def characters(self) -> int:
        points = 16 if self.kind is Kind.SIXTEENS else 1
        return self.size // points * _DIGITS[self.kind]

    def encode(self, units: Sequence[int]) -> str:
        """Returns the data characters; in a word of points the head device is the lowest bit."""
        if self.kind is Kind.BITS:
            return "".join(str(unit & 1) for unit in units)
        if self.kind is Kind.SIXTEENS:
            rows = (units[i : i + 16] for i in range(0, len(units), 16))
            units = [sum((bit & 1) << i for i, bit in enumerate(row)) for row in rows]
        digits = _DIGITS[self.kind]
        return "".join(f"{unit & (1 << 4 * digits) - 1:0{digits}X}" for unit in units)

    def decode(self, data: str) -> list[int]:
        legal = "[01]*" if self.kind is Kind.BITS else "[0-9A-F]*"
        if not re.fullmatch(legal, data):
            raise Rejected("07")
        digits = _DIGITS[self.kind]
        units = [int(data[i : i + digits], 16) for i in range(0, len(data), digits)]
        if self.kind is not Kind.SIXTEENS:
            return units
        return [int(bit) for unit in units for bit in reversed(f"{unit:016b}")]


def locate(name: str, in_words: bool, count: int) -> Cells:
    """Returns `count` devices from the five-character `name` on. Raises `Rejected` 06."""
    area, number = _device(name)
    is_bit = area in _BIT_AREAS or area in _CONTACTS
    if in_words and is_bit:
        if area in _CONTACTS or number % 8:
            raise Rejected("06")
        return Cells(area, number, 16 * count, Kind.SIXTEENS)
    if in_words != (not is_bit):
        raise Rejected("06")
    kind = Kind.BITS if is_bit else Kind.DWORDS if area == "C32" else Kind.WORDS
    return Cells(area, number, count, kind)


def _device(name: str) -> tuple[str, int]:
    match = _NAME.fullmatch(name)
    if match is None:
        raise Rejected("06")
    octal, octal_digits, letter, digits, pair, pair_digits = match.groups()
    if octal:
        return octal, int(octal_digits, 8)
    if letter:
        number = int(digits)
        return (f"{letter}8" if number >= 8000 and letter != "S" else letter), number
    number = int(pair_digits)
    match pair:
        case "TN":
            return "T", number
        case "CN":
            return ("C" if number < 200 else "C32"), number
    return pair, number
