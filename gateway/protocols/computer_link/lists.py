"""Several unconnected spans in one exchange: written by BT and WT, registered by BM and WM.

Liyan Computer Link manual 2-5 to 2-10.
"""

from collections.abc import Sequence
from itertools import pairwise

from gateway.protocols.computer_link.devices import DEVICE, Profile
from gateway.protocols.computer_link.ways import Way, bit_by_bit, words_around, words_exactly
from gateway.protocols.driver import Span, Unit


def scattered_ways(profile: Profile, spans: Sequence[Span]) -> list[Way] | None:
    """The cheaper of BT and WT; None where neither can write all spans, or where two meet."""
    if _overlap(spans):
        return None
    bits = _list(profile.scattered_bits, [bit_by_bit(profile, span) for span in spans])
    words = _list(profile.scattered_words, [words_exactly(profile, span) for span in spans])
    if bits is None or words is None:
        return bits or words
    return min(bits, words, key=listed_characters)


def monitored_ways(profile: Profile, spans: Sequence[Span]) -> list[Way] | None:
    """The cheaper of MB and MN; None where neither list can hold all spans."""
    bits = _list(profile.monitored, [bit_by_bit(profile, span) for span in spans])
    words = _list(profile.monitored, [words_around(profile, span) for span in spans])
    if bits is None or words is None:
        return bits or words
    return min(bits, words, key=data_characters)


def _list(limit: int, ways: Sequence[Way | None]) -> list[Way] | None:
    """The ways, if all go and they name no more than `limit` devices and no 32-bit counter."""
    going = [way for way in ways if way is not None and way.area.unit is not Unit.DWORD]
    if not going or len(going) < len(ways) or sum(way.pieces for way in going) > limit:
        return None
    return going


def listed_characters(ways: Sequence[Way]) -> int:
    """The characters of devices and data in BT and WT."""
    return sum(way.pieces * (DEVICE + way.digits) for way in ways)


def _overlap(spans: Sequence[Span]) -> bool:
    row = sorted(spans)
    return any(
        one.area == next_.area and one.start + one.size > next_.start
        for one, next_ in pairwise(row)
    )


def data_characters(ways: Sequence[Way]) -> int:
    """The characters of data in MB and MN."""
    return sum(way.characters for way in ways)


def decode_all(ways: Sequence[Way], data: str) -> list[Sequence[int]] | None:
    """The units of each way, whose data stand one after the other in `data`."""
    found: list[Sequence[int]] = []
    for way in ways:
        units = way.decode(data[: way.characters])
        if units is None:
            return None
        found.append(units)
        data = data[way.characters :]
    return None if data else found
