"""Mistakes in the file, reported all at once, each with its place."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Protocol

from gateway.errors import ConfigError

Path = tuple[str | int, ...]


class ConfigErrors(ConfigError):
    """Every mistake of one file. `messages` are `file:line: path: mistake`, by line."""

    def __init__(self, messages: Sequence[str]) -> None:
        super().__init__("\n".join(messages))
        self.messages = tuple(messages)


class Places(Protocol):
    """The lines of the file, by path."""

    @property
    def name(self) -> str: ...

    def line(self, path: Path) -> int:
        """Returns the line, from 1, of the deepest part of `path` in the file."""


@dataclass(slots=True)
class Mistakes:
    """The mistakes found so far in one file."""

    places: Places
    _found: list[tuple[int, str]] = field(default_factory=list)

    def add(self, path: Path, what: str) -> None:
        line = self.places.line(path)
        where = f"{dotted(path)}: " if path else ""
        entry = (line, f"{self.places.name}:{line}: {where}{what}")
        if entry not in self._found[-20:]:
            self._found.append(entry)

    def __len__(self) -> int:
        return len(self._found)

    def raise_all(self) -> None:
        """Raises `ConfigErrors` if there was any mistake."""
        if self._found:
            self._found.sort(key=lambda entry: entry[0])
            raise ConfigErrors([message for _, message in self._found])


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
    choices, lower = list(known), name.lower()
    for spelt in (lower, lower.replace("-", "_")):
        if close := get_close_matches(spelt, choices, n=1, cutoff=0.7):
            return f"did you mean {close[0]}?"
    whole = [choice for choice in choices if choice.startswith(lower) or lower.startswith(choice)]
    if lower and len(whole) == 1:
        return f"did you mean {whole[0]}?"
    return f"use {one_of(choices)}"


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
            return repr(value)


def _digits(value: int) -> str:
    return str(value) if value.bit_length() < 128 else "such a large number"
