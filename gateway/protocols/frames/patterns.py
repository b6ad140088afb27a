"""Regular expressions whose matching time is short for every frame.

Python's matcher tries every way to divide a frame among the repeats of a pattern; of some
patterns a frame of 40 bytes takes years, and the whole gateway would stand still. So the ways
are counted here, when the file is read: a repeat that can end in one place only (`[0-9]+` before
a comma) counts once, one whose end is open (`.*` before a digit) as often as it may repeat.
"""

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

from gateway.errors import ConfigError

# Ways times frame length; each step takes some 20 ns, so that a frame takes 20 ms at the worst.
_MOST_STEPS = 1_000_000

_REPEAT = re.compile(r"(?:([*+?])|\{([0-9]*)(,?)([0-9]*)\})[?+]?")
_GROUP = re.compile(r"\((?:\?:|\?P<[A-Za-z_][A-Za-z0-9_]*>|(?!\?))")
_ESCAPE = re.compile(r"\\(?:x[0-9A-Fa-f]{2}|[^0-9])", re.DOTALL)
_CLASS = re.compile(r"\[\^?\]?(?:\\.|[^\]\\])*\]", re.DOTALL)
_REPEATS = {"*": (0, None), "+": (1, None), "?": (0, 1)}


@lru_cache(maxsize=1024)
def pattern(text: str) -> re.Pattern[bytes]:
    """The compiled pattern, in which `.` is any byte at all. Raises `ConfigError`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # `[[`: a later Python may read it differently
            return re.compile(text.encode("latin-1"), re.DOTALL)
    except UnicodeEncodeError:
        raise ConfigError(f"{text!r}: write characters beyond Latin-1 as bytes, \\xE4") from None
    except (re.error, Warning, OverflowError, RecursionError) as error:
        raise ConfigError(f"{text!r} is no regular expression: {error}") from None


def check_pattern(text: str, longest: int) -> None:
    """Raises `ConfigError` for a pattern that is wrong, or slow on a frame of `longest` bytes."""
    pattern(text)
    steps = _Parser(text, longest).choice().ways(frozenset()) * longest
    if steps > _MOST_STEPS:
        raise ConfigError(
            f"{text!r} could keep the gateway busy: give its repeats bounds ({{1,8}} for +), "
            "let each end before a character it cannot take itself, or lower max_length"
        )


@lru_cache(maxsize=1024)
def longest_match(text: str, longest: int) -> int:
    """The most bytes that a frame of at most `longest` has if it matches."""
    return min(longest, _Parser(text, longest).choice().width)


Octets = frozenset[int]


class _Node(NamedTuple):
    """A part of a pattern."""

    first: Octets  # the bytes it can begin with
    empty: bool  # it can match an empty text
    width: int  # the most bytes it can match
    ways: Callable[[Octets], int]  # to match a stretch of bytes, with one of these behind it

    def before(self, follow: Octets) -> Octets:
        """Returns the bytes that the part can begin with, with one of `follow` behind it."""
        return self.first | follow if self.empty else self.first


def _atom(octets: Octets) -> _Node:
    """One byte out of a set; of an empty set: a place, not a byte (`^`, `$`)."""
    return _Node(octets, not octets, 1 if octets else 0, lambda follow: 1)


def _sequence(parts: Sequence[_Node]) -> _Node:
    first: Octets = frozenset()
    for part in reversed(parts):
        first = part.before(first)

    def ways(follow: Octets) -> int:
        total = 1
        for part in reversed(parts):
            total = _capped(total * part.ways(follow))
            follow = part.before(follow)
        return total

    return _Node(first, all(part.empty for part in parts), sum(part.width for part in parts), ways)


def _choice(branches: Sequence[_Node]) -> _Node:
    def ways(follow: Octets) -> int:
        each = [branch.ways(follow) for branch in branches]
        return max(each) if _told_apart(branches, follow) else _capped(sum(each))

    first = frozenset[int]().union(*(branch.first for branch in branches))
    empty, width = any(one.empty for one in branches), max(one.width for one in branches)
    return _Node(first, empty, width, ways)


def _repeat(part: _Node, least: int, most: int) -> _Node:
    def ways(follow: Octets) -> int:
        inner = part.ways(follow | part.first if most > 1 else follow)
        total = 1
        for _ in range(most if inner > 1 else 0):
            total = _capped(total * inner)
        open_end = bool(part.first & follow) or part.empty
        return _capped(total * (most - least + 1)) if open_end else total

    return _Node(part.first, least == 0 or part.empty, most * part.width, ways)


def _told_apart(branches: Sequence[_Node], follow: Octets) -> bool:
    seen: Octets = frozenset()
    for branch in branches:
        if seen & branch.before(follow):
            return False
        seen |= branch.before(follow)
    return sum(branch.empty for branch in branches) <= 1


def _capped(ways: int) -> int:
    return min(ways, _MOST_STEPS + 1)


class _Parser:
    """Parses a pattern that compiles."""

    def __init__(self, text: str, longest: int) -> None:
        self._text = text
        self._longest = longest
        self._at = 0

    def choice(self) -> _Node:
        branches = [_sequence(list(self._items()))]
        while self._text.startswith("|", self._at):
            self._at += 1
            branches.append(_sequence(list(self._items())))
        return _choice(branches) if len(branches) > 1 else branches[0]

    def _items(self) -> Iterator[_Node]:
        while self._at < len(self._text) and self._text[self._at] not in "|)":
            node = self._group() if self._text[self._at] == "(" else self._atom()
            yield self._repeated(node)

    def _group(self) -> _Node:
        opening = _GROUP.match(self._text, self._at)
        if opening is None:
            raise ConfigError(
                f"{self._text!r}: of groups there are (...), (?:...) and (?P<name>...) only"
            )
        self._at = opening.end()
        node = self.choice()
        self._at += 1
        return node

    def _atom(self) -> _Node:
        rule = {"\\": _ESCAPE, "[": _CLASS}.get(self._text[self._at])
        end = self._at + 1
        if rule is not None:
            found = rule.match(self._text, self._at)
            if found is None:
                raise ConfigError(
                    f"{self._text!r}: a backslash stands before one character or two hex "
                    r"digits (\x00), never before a number"
                )
            end = found.end()
        atom = self._text[self._at : end]
        self._at = end
        return _atom(_set_of(atom))

    def _repeated(self, node: _Node) -> _Node:
        match = _REPEAT.match(self._text, self._at)
        if match is None or match[0].rstrip("?+") in ("{}", "{,}"):
            return node
        self._at = match.end()
        least, most = _bounds(match)
        most = self._longest if most is None else min(most, self._longest)
        return _repeat(node, min(least, most), most)


def _bounds(match: re.Match[str]) -> tuple[int, int | None]:
    if match[1]:
        return _REPEATS[match[1]]
    least = int(match[2] or 0)
    if not match[3]:
        return least, least
    return least, int(match[4]) if match[4] else None


@lru_cache(maxsize=512)
def _set_of(atom: str) -> Octets:
    try:
        rule = re.compile(atom.encode("latin-1"), re.DOTALL)
    except re.error:
        return frozenset(atom.encode("latin-1"))  # a lone `{`, `]`
    return frozenset(octet for octet in range(256) if rule.fullmatch(bytes([octet])))
