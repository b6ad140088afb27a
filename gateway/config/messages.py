"""Mistakes in the file, reported all at once, each with its place."""

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import NamedTuple, Protocol

from gateway.errors import ConfigError

Path = tuple[str | int, ...]
MOST_ALIKE = 10  # mistakes of one kind that are shown one by one
_VALUE = re.compile(r"'[^']*'|[0-9]+")
_MEANT = re.compile(r"did you mean (\w+)\?")


class ConfigErrors(ConfigError):
    """Every mistake of one file. `messages` are `file:line: path: mistake`, by line.

    `count`: of the mistakes; many alike have one message.
    """

    def __init__(self, messages: Sequence[str], count: int | None = None) -> None:
        super().__init__("\n".join(messages))
        self.messages = tuple(messages)
        self.count = len(messages) if count is None else count


class Places(Protocol):
    """The lines of the file, by path."""

    @property
    def name(self) -> str: ...

    def line(self, path: Path) -> int:
        """Returns the line, from 1, of the deepest part of `path` in the file."""

    def at(self, line: int, path: Path) -> str:
        """Returns the beginning of a message: file, line and path, with a colon behind them."""


class OptionPlaces:
    """The places of settings that are options of a command."""

    name = "options"

    def line(self, path: Path) -> int:
        return len(path)

    def at(self, line: int, path: Path) -> str:
        return f"{path[-1]}: " if path else ""


class Mistake(NamedTuple):
    line: int
    path: Path
    what: str
    begin: str = ""  # of the message; left out: from line and path

    @property
    def kind(self) -> tuple[object, str]:
        """Equal for mistakes with one cause: the same setting, and the same words."""
        return self.path[-1:], _VALUE.sub("", self.what)


@dataclass(slots=True)
class Mistakes:
    """The mistakes found so far in one file, to be noted below `path`. `elsewhere`: it is the file
    of another machine, which has the files that it names."""

    places: Places
    elsewhere: bool = False
    path: Path = ()
    _found: list[Mistake] = field(default_factory=list)
    _others: list["Mistakes"] = field(default_factory=list)

    def at(self, *place: str | int) -> "Mistakes":
        """Returns the same mistakes; those noted there are below the place."""
        path = (*self.path, *place)
        return Mistakes(self.places, self.elsewhere, path, self._found, self._others)

    def add(self, what: str, *place: str | int) -> None:
        """Notes a mistake at the path, or at a place below it."""
        path = (*self.path, *place)
        mistake = Mistake(self.places.line(path), path, what)
        if mistake not in self._found[-20:]:
            self._found.append(mistake)

    def add_at(self, line: int, begin: str, what: str) -> None:
        """Adds a mistake that has no path. `begin`: of its message."""
        self._found.append(Mistake(line, (), what, begin))

    def include(self, other: "Mistakes") -> None:
        """Adds the mistakes of another file, after those of this one."""
        self._others.append(other)

    def has(self, path: Path) -> bool:
        """Returns True if the setting has a mistake already."""
        return any(mistake.path == path for mistake in self._found)

    def sentences(self) -> list[str]:
        """Returns the mistakes without their places."""
        return [mistake.what for mistake in self._found]

    def __len__(self) -> int:
        return len(self._found) + sum(map(len, self._others))

    def raise_all(self) -> None:
        """Raises `ConfigErrors` if there was any mistake."""
        if len(self):
            raise ConfigErrors(list(self._messages()), len(self))

    def _messages(self) -> Iterator[str]:
        """Yields the mistakes by line; of many alike the first ten, and the number of others."""
        misspelt = {
            (*path[:-1], m[1]) for _, path, what, _ in self._found if (m := _MEANT.search(what))
        }
        kinds = defaultdict[object, list[Mistake]](list)
        for mistake in sorted(self._found, key=lambda mistake: mistake.line):
            if not (mistake.path in misspelt and mistake.what.startswith("missing")):
                kinds[mistake.kind].append(mistake)
        shown = [m for alike in kinds.values() for m in alike[:MOST_ALIKE]]
        for line, path, what, begin in sorted(shown, key=lambda mistake: mistake.line):
            yield f"{begin or self.places.at(line, path)}{what}"
        for alike in kinds.values():
            if more := alike[MOST_ALIKE:]:
                begin = self.places.at(more[0].line, ())
                yield f"{begin}{len(more)} more like: {alike[0].what}"
        for other in self._others:
            yield from other._messages()


def dotted(path: Path) -> str:
    """`lines.hall-1.devices.mixer`, list items as `listen[0]`."""
    text = ""
    for chunk in path:
        text += f"[{chunk}]" if isinstance(chunk, int) else f".{chunk}" if text else chunk
    return text


def one_of(names: Iterable[str]) -> str:
    """`a, b or c`."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def meant(name: str, known: Iterable[str]) -> str:
    """Suggests the most similar name, or all names."""
    if name.isdecimal():  # {scale: 0,1} is a scale of 0, and a setting 1
        return "a number has a point, not a comma, such as 0.1"
    if ":" in name:
        return f"write a space after the colon: {name.replace(':', ': ', 1)}"
    choices, lower = list(known), name.lower()
    for spelt in (lower, lower.replace("-", "_")):
        if close := similar(spelt, choices):
            return f"did you mean {close}?"
    whole = [choice for choice in choices if choice.startswith(lower) or lower.startswith(choice)]
    if lower and len(whole) == 1:
        return f"did you mean {whole[0]}?"
    return f"use {one_of(choices)}"


def similar(name: str, known: Iterable[str]) -> str | None:
    """Returns the most similar name, if one is similar enough to be meant."""
    return next(iter(get_close_matches(name, known, n=1, cutoff=0.7)), None)


def shown(value: object) -> str:
    """Returns a value as the file writes it."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "true" if value else "false"
        case dict():
            return "a mapping"
        case list():
            return "a list"
        case int() | float():
            return f"{value:.15g}" if isinstance(value, float) else _digits(value)
        case _:
            text = repr(value)
            return f"{text} (\\xa0 is a no-break space)" if r"\xa0" in text else text


def _digits(value: int) -> str:
    return str(value) if value.bit_length() < 128 else "such a large number"
