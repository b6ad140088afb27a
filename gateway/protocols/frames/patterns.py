"""Regular expressions whose matching time is short for every frame.

Python's matcher tries every way to divide a frame among the repeats of a pattern; of some
patterns a frame of 40 bytes takes years, and the whole gateway would stand still. So the ways
are counted here, when the file is read: a repeat that can end in one place only (`[0-9]+` before
a comma) counts once, one whose end is open (`.*` before a digit) as often as it may repeat.
"""

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

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
    steps = _ways(_Parser(text, longest).whole(), frozenset(), longest) * longest
    if steps > _MOST_STEPS:
        raise ConfigError(
            f"{text!r} could keep the gateway busy: give its repeats bounds ({{1,8}} for +), "
            "let each end before a character it cannot take itself, or lower max_length"
        )


@lru_cache(maxsize=1024)
def longest_match(text: str, longest: int) -> int:
    """The most bytes that a frame of at most `longest` has if it matches."""
    return min(longest, _width(_Parser(text, longest).whole()))


@dataclass(frozen=True, slots=True)
class _Atom:
    """One byte out of a set; of an empty set: a place, not a byte (`^`, `$`)."""

    octets: frozenset[int]


@dataclass(frozen=True, slots=True)
class _Sequence:
    parts: tuple["_Node", ...]


@dataclass(frozen=True, slots=True)
class _Choice:
    branches: tuple["_Node", ...]


@dataclass(frozen=True, slots=True)
class _Repeat:
    part: "_Node"
    least: int
    most: int


_Node = _Atom | _Sequence | _Choice | _Repeat


def _first(node: _Node) -> frozenset[int]:
    """The bytes it can begin with."""
    match node:
        case _Atom(octets):
            return octets
        case _Sequence(parts):
            found: frozenset[int] = frozenset()
            for part in parts:
                found |= _first(part)
                if not _empty(part):
                    break
            return found
        case _Choice(branches):
            return frozenset().union(*map(_first, branches))
        case _Repeat(part):
            return _first(part)


def _empty(node: _Node) -> bool:
    """True when it can match an empty text."""
    match node:
        case _Atom(octets):
            return not octets
        case _Sequence(parts):
            return all(map(_empty, parts))
        case _Choice(branches):
            return any(map(_empty, branches))
        case _Repeat(part, least):
            return least == 0 or _empty(part)


def _width(node: _Node) -> int:
    """The most bytes it can match."""
    match node:
        case _Atom(octets):
            return 1 if octets else 0
        case _Sequence(parts):
            return sum(map(_width, parts))
        case _Choice(branches):
            return max(map(_width, branches), default=0)
        case _Repeat(part, _, most):
            return most * _width(part)


def _ways(node: _Node, follow: frozenset[int], longest: int) -> int:
    """The most ways to match a stretch of bytes, where a byte of `follow` comes behind it."""
    match node:
        case _Atom():
            return 1
        case _Sequence(parts):
            total = 1
            for part in reversed(parts):
                total = _capped(total * _ways(part, follow, longest))
                follow = _first(part) | follow if _empty(part) else _first(part)
            return total
        case _Choice(branches):
            each = [_ways(branch, follow, longest) for branch in branches]
            return max(each) if _told_apart(branches, follow) else _capped(sum(each))
        case _Repeat():
            return _repeat_ways(node, follow, longest)


def _repeat_ways(node: _Repeat, follow: frozenset[int], longest: int) -> int:
    again = _first(node.part)
    inner = _ways(node.part, follow | again if node.most > 1 else follow, longest)
    total = 1
    for _ in range(node.most if inner > 1 else 0):
        total = _capped(total * inner)
    open_end = bool(again & follow) or _empty(node.part)
    return _capped(total * (node.most - node.least + 1)) if open_end else total


def _told_apart(branches: tuple[_Node, ...], follow: frozenset[int]) -> bool:
    seen: frozenset[int] = frozenset()
    for branch in branches:
        first = _first(branch) | follow if _empty(branch) else _first(branch)
        if seen & first:
            return False
        seen |= first
    return sum(map(_empty, branches)) <= 1


def _capped(ways: int) -> int:
    return min(ways, _MOST_STEPS + 1)


class _Parser:
    """Parses a pattern that compiles."""

    def __init__(self, text: str, longest: int) -> None:
        self._text = text
        self._longest = longest
        self._at = 0

    def whole(self) -> _Node:
        return self._choice()

    def _choice(self) -> _Node:
        branches = [_Sequence(tuple(self._items()))]
        while self._text.startswith("|", self._at):
            self._at += 1
            branches.append(_Sequence(tuple(self._items())))
        return _Choice(tuple(branches)) if len(branches) > 1 else branches[0]

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
        node = self._choice()
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
        return _Atom(_set_of(atom))

    def _repeated(self, node: _Node) -> _Node:
        match = _REPEAT.match(self._text, self._at)
        if match is None or match[0].rstrip("?+") in ("{}", "{,}"):
            return node
        self._at = match.end()
        least, most = _bounds(match)
        most = self._longest if most is None else min(most, self._longest)
        return _Repeat(node, min(least, most), most)


def _bounds(match: re.Match[str]) -> tuple[int, int | None]:
    if match[1]:
        return _REPEATS[match[1]]
    least = int(match[2] or 0)
    if not match[3]:
        return least, least
    return least, int(match[4]) if match[4] else None


@lru_cache(maxsize=512)
def _set_of(atom: str) -> frozenset[int]:
    try:
        rule = re.compile(atom.encode("latin-1"), re.DOTALL)
    except re.error:
        return frozenset(atom.encode("latin-1"))  # a lone `{`, `]`
    return frozenset(octet for octet in range(256) if rule.fullmatch(bytes([octet])))
