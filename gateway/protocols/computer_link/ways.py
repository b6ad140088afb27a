"""The ways a span can go over the wire, bit by bit or in words, and what each one carries.

Bit devices may be taken in words of sixteen points whose head number is a multiple of 8
(X and Y: an octal number that ends in 0). A read may take more than was asked, a write may not.
"""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from gateway.errors import BadValue
from gateway.protocols.computer_link.devices import Profile, wire_name
from gateway.protocols.driver import Area, Span, Unit

HEAD = 8
SIXTEEN = 16
_NO_WORDS = ("TS", "CS")  # timer and counter contacts go bit by bit only (manual 1-7-1)
_DIGITS = {Unit.BIT: 4, Unit.WORD: 4, Unit.DWORD: 8}
_HEX = re.compile(r"[0-9A-F]*")
_BITS = re.compile(r"[01]*")


class Way(NamedTuple):
    """How `asked` travels: `pieces` of `digits` characters, from `head` on, `step` apart."""

    asked: Span
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
        """Head device and number of pieces, as BR, WR, BW and WW name them (256 is "00")."""
        return f"{wire_name(self.area, self.head)}{self.pieces & 0xFF:02X}"

    def devices(self) -> Iterator[str]:
        """The device of each piece, as BT, WT, BM and WM name them."""
        for piece in range(self.pieces):
            yield wire_name(self.area, self.head + piece * self.step)

    def decode(self, data: str) -> list[int] | None:
        """The units asked for; None for characters that cannot be their data."""
        legal = _HEX if self.in_words else _BITS
        if len(data) != self.characters or not legal.fullmatch(data):
            return None
        units = [int(data[i : i + self.digits], 16) for i in range(0, len(data), self.digits)]
        if self.step == 1:
            return units
        # Each word's least significant bit is its head device.
        bits = [word >> bit & 1 for word in units for bit in range(SIXTEEN)]
        first = self.asked.start - self.head
        return bits[first : first + self.asked.size]

    def encode(self, units: Sequence[int]) -> list[str]:
        """The pieces that say `units`. Raises `BadValue` for what does not fit."""
        top = 1 if self.area.unit is Unit.BIT else 16**self.digits - 1
        if len(units) != self.asked.size or not all(0 <= unit <= top for unit in units):
            raise BadValue(f"{self.asked} takes {self.asked.size} units of 0..{top}")
        if self.step == SIXTEEN:
            units = [
                sum(bit << i for i, bit in enumerate(units[start : start + SIXTEEN]))
                for start in range(0, len(units), SIXTEEN)
            ]
        return [f"{unit:0{self.digits}X}" for unit in units]


def read_way(profile: Profile, span: Span) -> Way | None:
    """The cheaper of BR and WR; None where neither can read the span in one exchange."""
    return _cheaper(
        _at_most(profile.read_bits, bit_by_bit(profile, span)),
        _within(profile, words_around(profile, span), profile.read_sixteens),
    )


def write_way(profile: Profile, span: Span) -> Way | None:
    """The cheaper of BW and WW; None where neither can write the span in one exchange."""
    # WW would take more points than BW (Liyan: 8 words are 128, BW takes 64), but only where
    # they lie in words. If a span cannot be written no longer one may be, so BW's limit holds.
    sixteens = profile.write_bits // SIXTEEN
    return _cheaper(
        _at_most(profile.write_bits, bit_by_bit(profile, span)),
        _within(profile, words_exactly(profile, span), sixteens),
    )


def bit_by_bit(profile: Profile, span: Span) -> Way | None:
    """One character a point; None for words and for what the device does not have."""
    area = _area(profile, span)
    if area is None or area.unit is not Unit.BIT:
        return None
    return Way(span, area, False, span.start, 1, span.size, 1)


def words_exactly(profile: Profile, span: Span) -> Way | None:
    """Words that hold the span and nothing else; None where there are none."""
    area = _area(profile, span)
    if area is None or area.name in _NO_WORDS:
        return None
    if area.unit is not Unit.BIT:
        return Way(span, area, True, span.start, 1, span.size, _DIGITS[area.unit])
    if span.start % HEAD or span.size % SIXTEEN:
        return None
    return Way(span, area, True, span.start, SIXTEEN, span.size // SIXTEEN, 4)


def words_around(profile: Profile, span: Span) -> Way | None:
    """The fewest words that cover the span and do not leave its area."""
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
            return Way(span, area, True, head, SIXTEEN, count, 4)
    return None


def _area(profile: Profile, span: Span) -> Area | None:
    area = profile.areas.get(span.area)
    if area is None or span.size < 1:
        return None
    inside = area.first <= span.start and span.start + span.size <= area.last + 1
    return area if inside else None


def _within(profile: Profile, way: Way | None, sixteens: int) -> Way | None:
    if way is None:
        return None
    limits = {Unit.BIT: sixteens, Unit.WORD: profile.words, Unit.DWORD: profile.dwords}
    return _at_most(limits[way.area.unit], way)


def _at_most(limit: int, way: Way | None) -> Way | None:
    return way if way is not None and way.pieces <= limit else None


def _cheaper(bits: Way | None, words: Way | None) -> Way | None:
    """Bit by bit where it costs no more: that asks for nothing beside the span."""
    if bits is None or words is None:
        return bits or words
    return words if words.characters < bits.characters else bits
