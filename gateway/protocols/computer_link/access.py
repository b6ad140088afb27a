"""Access to spans, bit by bit or in words: the devices and characters of the request.

Bit devices may be accessed in words of sixteen points whose head number is a multiple of 8
(X and Y: an octal number that ends in 0). A read may take more than the span, a write may not.
BT and WT write several separate spans, BM and WM register them (Liyan manual 2-5 to 2-10).
"""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple, TypeVar

from gateway.errors import BadValue
from gateway.protocols.computer_link.devices import DEVICE, Profile, wire_name
from gateway.protocols.driver import Area, Span, Unit

T = TypeVar("T")

HEAD = 8
SIXTEEN = 16
_NO_WORDS = ("TS", "CS")  # timer and counter contacts are read bit by bit only (manual 1-7-1)
_DIGITS = {Unit.BIT: 4, Unit.WORD: 4, Unit.DWORD: 8}
_HEX = re.compile(r"[0-9A-F]*")
_BITS = re.compile(r"[01]*")


class Access(NamedTuple):
    """One access to read or write a span: `pieces` of `digits` characters, `step` devices apart."""

    span: Span
    area: Area
    in_words: bool
    head: int
    step: int
    pieces: int
    digits: int

    @property
    def characters(self) -> int:
        return self.pieces * self.digits

    @property
    def batch(self) -> str:
        """Head device and number of pieces, as BR, WR, BW and WW take them (256 is "00")."""
        return f"{wire_name(self.area, self.head)}{self.pieces & 0xFF:02X}"

    def devices(self) -> Iterator[str]:
        """Yields the device of each piece, as BT, WT, BM and WM take it."""
        for piece in range(self.pieces):
            yield wire_name(self.area, self.head + piece * self.step)

    def decode(self, data: str) -> list[int] | None:
        """Returns the units of the span; None for characters that cannot be their data."""
        legal = _HEX if self.in_words else _BITS
        if len(data) != self.characters or not legal.fullmatch(data):
            return None
        units = [int(data[i : i + self.digits], 16) for i in range(0, len(data), self.digits)]
        if self.step == 1:
            return units
        # Each word's least significant bit is its head device.
        bits = [word >> bit & 1 for word in units for bit in range(SIXTEEN)]
        first = self.span.start - self.head
        return bits[first : first + self.span.size]

    def encode(self, units: Sequence[int]) -> list[str]:
        """Returns the pieces for `units`. Raises `BadValue` for units that do not fit."""
        top = 1 if self.area.unit is Unit.BIT else 16**self.digits - 1
        if len(units) != self.span.size or not all(0 <= unit <= top for unit in units):
            raise BadValue(f"{self.span} takes {self.span.size} units of 0..{top}")
        if self.step == SIXTEEN:
            units = [
                sum(bit << i for i, bit in enumerate(units[start : start + SIXTEEN]))
                for start in range(0, len(units), SIXTEEN)
            ]
        return [f"{unit:0{self.digits}X}" for unit in units]


def read_access(profile: Profile, span: Span) -> Access | None:
    """Returns the cheaper of BR and WR; None where neither reads the span in one request."""
    return _cheaper(
        _at_most(profile.read_bits, bit_by_bit(profile, span)),
        _within(profile, words_around(profile, span), profile.read_sixteens),
    )


def write_access(profile: Profile, span: Span) -> Access | None:
    """Returns the cheaper of BW and WW; None where neither writes the span in one request."""
    # WW takes more points than BW (Liyan: 8 words are 128, BW takes 64), but only where they lie
    # in words. If a span cannot be written, no longer one may be: so the limit of BW holds.
    sixteens = profile.write_bits // SIXTEEN
    return _cheaper(
        _at_most(profile.write_bits, bit_by_bit(profile, span)),
        _within(profile, words_exactly(profile, span), sixteens),
    )


def bit_by_bit(profile: Profile, span: Span) -> Access | None:
    """One character per point; None for words and for devices that do not exist."""
    area = _area(profile, span)
    if area is None or area.unit is not Unit.BIT:
        return None
    return Access(span, area, False, span.start, 1, span.size, 1)


def words_exactly(profile: Profile, span: Span) -> Access | None:
    """Words that hold exactly the span; None where there are none."""
    area = _area(profile, span)
    if area is None or area.name in _NO_WORDS:
        return None
    if area.unit is not Unit.BIT:
        return Access(span, area, True, span.start, 1, span.size, _DIGITS[area.unit])
    if span.start % HEAD or span.size % SIXTEEN:
        return None
    return Access(span, area, True, span.start, SIXTEEN, span.size // SIXTEEN, 4)


def words_around(profile: Profile, span: Span) -> Access | None:
    """The fewest words that hold the span and stay within its area."""
    area = _area(profile, span)
    if area is None or area.name in _NO_WORDS:
        return None
    if area.unit is not Unit.BIT:
        return words_exactly(profile, span)
    aligned = span.start - span.start % HEAD
    end = span.start + span.size
    for head in (aligned, aligned - HEAD):  # the earlier head where the area ends too soon
        count = -(-(end - head) // SIXTEEN)
        if head >= area.first and head + count * SIXTEEN <= area.last + 1:
            return Access(span, area, True, head, SIXTEEN, count, 4)
    return None


def _area(profile: Profile, span: Span) -> Area | None:
    area = profile.areas.get(span.area)
    return area if area is not None and area.holds(span) else None


def _within(profile: Profile, access: Access | None, sixteens: int) -> Access | None:
    if access is None:
        return None
    limits = {Unit.BIT: sixteens, Unit.WORD: profile.words, Unit.DWORD: profile.dwords}
    return _at_most(limits[access.area.unit], access)


def _at_most(limit: int, access: Access | None) -> Access | None:
    return access if access is not None and access.pieces <= limit else None


def _cheaper(bits: Access | None, words: Access | None) -> Access | None:
    """Bit by bit where it costs no more: it reads nothing besides the span."""
    if bits is None or words is None:
        return bits or words
    return words if words.characters < bits.characters else bits


def possible(access: T | None, spans: object) -> T:
    """Raises `ValueError` for None: the plan was made with the costs, so this is a mistake."""
    if access is None:
        raise ValueError(f"{spans} does not fit one request")
    return access


def scattered_access(profile: Profile, spans: Sequence[Span]) -> list[Access] | None:
    """Returns the cheaper of BT and WT; None where neither writes all spans, or two overlap."""
    if _overlap(spans):
        return None
    bits = _list(profile.scattered_bits, [bit_by_bit(profile, span) for span in spans])
    words = _list(profile.scattered_words, [words_exactly(profile, span) for span in spans])
    if bits is None or words is None:
        return bits or words
    return min(bits, words, key=listed_characters)


def monitored_access(profile: Profile, spans: Sequence[Span]) -> list[Access] | None:
    """Returns the cheaper of MB and MN; None where neither list holds all spans."""
    bits = _list(profile.monitored, [bit_by_bit(profile, span) for span in spans])
    words = _list(profile.monitored, [words_around(profile, span) for span in spans])
    if bits is None or words is None:
        return bits or words
    return min(bits, words, key=data_characters)


def _list(limit: int, parts: Sequence[Access | None]) -> list[Access] | None:
    """Returns the parts; None where one is missing or a dword, or they exceed `limit` devices."""
    fit = [part for part in parts if part is not None and part.area.unit is not Unit.DWORD]
    if not fit or len(fit) < len(parts) or sum(part.pieces for part in fit) > limit:
        return None
    return fit


def listed_characters(parts: Sequence[Access]) -> int:
    """The characters of devices and data in BT and WT."""
    return sum(part.pieces * (DEVICE + part.digits) for part in parts)


def _overlap(spans: Sequence[Span]) -> bool:
    row = sorted(spans)
    return any(
        one.area == next_.area and one.start + one.size > next_.start
        for one, next_ in pairwise(row)
    )


def data_characters(parts: Sequence[Access]) -> int:
    """The characters of data in MB and MN."""
    return sum(part.characters for part in parts)


def decode_all(parts: Sequence[Access], data: str) -> list[Sequence[int]] | None:
    """Returns the units of each part; None for characters that cannot be their data."""
    found: list[Sequence[int]] = []
    for part in parts:
        units = part.decode(data[: part.characters])
        if units is None:
            return None
        found.append(units)
        data = data[part.characters :]
    return None if data else found
