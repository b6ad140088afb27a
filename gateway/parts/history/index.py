"""The index of a run: which of its samples belong to which tag."""

import struct
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from itertools import accumulate
from zlib import crc32

from gateway.errors import Damaged

_HEAD = struct.Struct("<III")  # checksum of the rest, number of tags, bytes of a sample's number


class Index:
    """The samples of each tag, by their numbers in the run."""

    def __init__(self, data: bytes) -> None:
        """`data`: from `pack`. Raises `Damaged`."""
        if len(data) < _HEAD.size or crc32(data[4:]) != _HEAD.unpack_from(data)[0]:
            raise Damaged("the index of a run is damaged")
        _, count, size = _HEAD.unpack_from(data)
        self._tags, self._ends, self._numbers = array("I"), array("I"), array("IH"[size == 2])
        ends, numbers = _HEAD.size + 4 * count, _HEAD.size + 8 * count
        self._tags.frombytes(data[_HEAD.size : ends])
        self._ends.frombytes(data[ends:numbers])
        self._numbers.frombytes(data[numbers:])

    def numbers(self, tags: Iterable[int]) -> list[int]:
        """Returns the numbers of the samples of these tags, in their order."""
        found: list[int] = []
        for tag in tags:
            place = bisect_left(self._tags, tag)
            if place < len(self._tags) and self._tags[place] == tag:
                begin = self._ends[place - 1] if place else 0
                found += self._numbers[begin : self._ends[place]]
        found.sort()
        return found


def pack(tags: Sequence[int]) -> bytes:
    """Returns the index of a run; `tags`: those of its samples."""
    by_tag: dict[int, list[int]] = {}
    for number, tag in enumerate(tags):
        by_tag.setdefault(tag, []).append(number)
    listed = sorted(by_tag)
    numbers = array("H" if len(tags) <= 2**16 else "I")
    for tag in listed:
        numbers.extend(by_tag[tag])
    ends = array("I", accumulate(len(by_tag[tag]) for tag in listed))
    body = array("I", listed).tobytes() + ends.tobytes() + numbers.tobytes()
    head = _HEAD.pack(0, len(listed), numbers.itemsize)[4:]
    return crc32(head + body).to_bytes(4, "little") + head + body
