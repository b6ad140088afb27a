"""Several separate spans in one request: written by BT and WT, registered by BM and WM.

Liyan Computer Link manual 2-5 to 2-10.
"""

from collections.abc import Sequence
from itertools import pairwise

from gateway.protocols.computer_link.access import Access, bit_by_bit, words_around, words_exactly
from gateway.protocols.computer_link.devices import DEVICE, Profile
from gateway.protocols.driver import Span, Unit


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
