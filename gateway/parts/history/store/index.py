"""The index of a run: which of its samples belong to which tag, and to which time."""

import struct
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Sequence
from itertools import accumulate
from typing import NamedTuple
from zlib import crc32

from gateway.contract.past.timerange import TimeRange
from gateway.errors import Damaged

GROUP = 1024  # samples whose first and last time is known
_HEAD = struct.Struct("<IIII")  # checksum of the rest, samples, tags, bytes of a sample's number


class Places(NamedTuple):
    """Samples that are read together, by their numbers in the run; none is before `first`."""

    first: int  # ns since 1970
    numbers: Sequence[int]


class Index:
    """The samples of each tag and of each time, by their numbers in the run."""

    def __init__(self, data: object) -> None:
        """`data`: from `pack`. Raises `Damaged`."""
        if not isinstance(data, bytes) or len(data) < _HEAD.size:
            raise Damaged("a run has no index")
        if crc32(data[4:]) != _HEAD.unpack_from(data)[0]:
            raise Damaged("the index of a run is damaged")
        _, self._samples, count, size = _HEAD.unpack_from(data)
        groups = -(-self._samples // GROUP)
        found: list[array[int]] = []
        at = _HEAD.size
        for kind, items in zip("qqII", (groups, groups, count, count), strict=True):
            found.append(array(kind, data[at : at + array(kind).itemsize * items]))
            at += array(kind).itemsize * items
        self._firsts, self._lasts, self._tags, self._ends = found
        self._numbers = array("IH"[size == 2], data[at:])

    def places(self, tags: Collection[int], period: TimeRange, most: int) -> list[Places]:
        """Returns the samples to read for these tags, in their order; for more than `most` tags all
        samples."""
        wanted = [
            group
            for group, (first, last) in enumerate(zip(self._firsts, self._lasts, strict=True))
            if first <= period.last and last >= period.first
        ]
        if not wanted:
            return []
        begin, end = wanted[0] * GROUP, min((wanted[-1] + 1) * GROUP, self._samples)
        if len(tags) <= most:
            found = self._of(tags, begin, end)
            if len(found) < (end - begin) // 4:
                parts = [found[at : at + GROUP] for at in range(0, len(found), GROUP)]
                return [
                    Places(min(self._firsts[part[0] // GROUP : part[-1] // GROUP + 1]), part)
                    for part in parts
                ]
        return [
            Places(self._firsts[group], range(group * GROUP, min((group + 1) * GROUP, end)))
            for group in wanted
        ]

    def _of(self, tags: Collection[int], begin: int, end: int) -> list[int]:
        found: list[int] = []
        for tag in tags:
            place = bisect_left(self._tags, tag)
            if place < len(self._tags) and self._tags[place] == tag:
                low, high = self._ends[place - 1] if place else 0, self._ends[place]
                first = bisect_left(self._numbers, begin, low, high)
                found += self._numbers[first : bisect_right(self._numbers, end - 1, low, high)]
        found.sort()
        return found


def pack(tags: Sequence[int], times: Sequence[int]) -> bytes:
    """Returns the index of a run with samples of these tags and times."""
    by_tag: dict[int, list[int]] = {}
    for number, tag in enumerate(tags):
        by_tag.setdefault(tag, []).append(number)
    listed = sorted(by_tag)
    numbers = array("H" if len(tags) <= 2**16 else "I")
    for tag in listed:
        numbers.extend(by_tag[tag])
    groups = [times[at : at + GROUP] for at in range(0, len(times), GROUP)]
    parts = (
        array("q", map(min, groups)),
        array("q", map(max, groups)),
        array("I", listed),
        array("I", accumulate(len(by_tag[tag]) for tag in listed)),
        numbers,
    )
    head = _HEAD.pack(0, len(tags), len(listed), numbers.itemsize)[4:]
    body = head + b"".join(part.tobytes() for part in parts)
    return crc32(body).to_bytes(4, "little") + body
