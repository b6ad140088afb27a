"""Recognises replies over a pair whose wires A and B are swapped: every bit is inverted.

An inverted line rests at the level of a start bit, which a receiver reports as one zero byte. In a
character it finds its first change to that level somewhere inside, and takes a byte from there. So
the bytes that arrive follow from the characters, and the begin of a good reply is known.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol, runtime_checkable

SWAPPED = "Replies arrive inverted, as when A and B are swapped: change the two wires"
_FORMATS = [(bits, parity) for bits in (7, 8) for parity in "ENO"]


@runtime_checkable
class KnownReplies(Protocol):
    """A driver that knows how the replies to its reads begin."""

    @property
    def reply_starts(self) -> Sequence[bytes]:
        """Three characters or more each."""


def is_swapped(heard: bytes, driver: KnownReplies) -> bool:
    """Returns True if the bytes are how a reply to a read begins, inverted."""
    return heard.lstrip(b"\0").startswith(_inverted(tuple(driver.reply_starts)))


@lru_cache(maxsize=256)
def _inverted(starts: tuple[bytes, ...]) -> tuple[bytes, ...]:
    """Returns what arrives of each beginning, in every character format."""
    found = {arriving(start, bits, parity) for start in starts for bits, parity in _FORMATS}
    return tuple(text for text in found if len(text) > 1)


def arriving(data: bytes, bits: int, parity: str) -> bytes:
    """Returns the bytes that a receiver takes from these characters over swapped wires.

    `bits`: data bits. `parity`: N, E or O. Bytes that depend on a character behind them are left
    out.
    """
    line = [0]
    for character in data:
        sent = [character >> place & 1 for place in range(bits)]
        if parity != "N":
            sent.append((character.bit_count() + (parity == "O")) & 1)
        line += [1, *(1 - bit for bit in sent), 0]
    length = 2 + bits + (parity != "N")
    found, place = bytearray(), 1
    while place + length <= len(line):
        if line[place - 1] > line[place]:
            taken = line[place + 1 : place + 1 + bits]
            found.append(sum(bit << at for at, bit in enumerate(taken)))
            place += length - 1
        else:
            place += 1
    return bytes(found)
