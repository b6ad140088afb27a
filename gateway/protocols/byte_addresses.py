"""The bytes that hold a span, for PLCs whose devices have byte addresses: Vigor and FX."""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

from gateway.protocols.driver import Area, Cost, Span, Unit

_WIDTH = {Unit.WORD: 2, Unit.DWORD: 4}  # bytes of a device
_BITS = tuple(tuple(byte >> place & 1 for place in range(8)) for byte in range(256))


class Cover(NamedTuple):
    """The bytes of one request for a span."""

    address: int
    size: int
    ahead: int  # bits before the span in its first byte
    behind: int  # bits after it in its last

    def write_cost(self, read: Cost, write: Cost) -> Cost:
        """Returns the cost of a write: bits that do not fill their bytes are read before."""
        if not self.ahead and not self.behind:
            return write
        return Cost(read.request + write.request, read.reply + write.reply)


def covering(places: Iterable[tuple[Area, int]], most: int) -> Callable[[Span], Cover | None]:
    """Returns the function that finds the bytes that hold a span; None for more than `most`, or a
    span outside its area. `places`: each area, and the byte address of its first device."""
    found = {area.name: (area, base) for area, base in places}

    @lru_cache(maxsize=4096)
    def cover(span: Span) -> Cover | None:
        area, base = found.get(span.area, (None, 0))
        if area is None or not area.holds(span):
            return None
        offset = span.start - area.first
        if width := _WIDTH.get(area.unit, 0):
            covered = Cover(base + width * offset, width * span.size, 0, 0)
        else:
            ahead = offset % 8
            size = (ahead + span.size + 7) // 8
            covered = Cover(base + offset // 8, size, ahead, 8 * size - ahead - span.size)
        return covered if covered.size <= most else None

    return cover


def bits_from_bytes(data: bytes) -> list[int]:
    """Returns eight bits of each byte, the lowest device first."""
    return list(chain.from_iterable(map(_BITS.__getitem__, data)))


def bytes_from_bits(bits: Sequence[int]) -> bytes:
    """The inverse, for whole bytes of bits."""
    return bytes(
        sum(bit << place for place, bit in enumerate(bits[at : at + 8]))
        for at in range(0, len(bits), 8)
    )
