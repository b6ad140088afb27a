"""Documents that others send, by one rule: bounded before they are parsed, checked before use.

A document is one JSON object. Each member has a type and a range. Members that the reader does not
know are ignored, so that a newer version may add some.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import orjson

from gateway.errors import BadValue


@dataclass(frozen=True, slots=True)
class Foreign:
    """One document. Every method raises `BadValue` for a member of another type or range."""

    _members: Mapping[str, object]

    @classmethod
    def parse(cls, data: bytes, longest: int) -> Self:
        """`longest`: bytes. Raises `BadValue` for anything but one object."""
        if len(data) > longest:
            raise BadValue(f"it has {len(data)} bytes, more than {longest}")
        try:
            found = orjson.loads(data)
        except orjson.JSONDecodeError:
            raise BadValue("it is no JSON") from None
        if not isinstance(found, dict):
            raise BadValue("it is no JSON object")
        return cls(found)

    def number(self, name: str, least: int, most: int) -> int:
        found = self._members.get(name)
        if isinstance(found, bool) or not isinstance(found, int) or not least <= found <= most:
            raise BadValue(f"{name} is no integer from {least} to {most}")
        return found

    def text(self, name: str, longest: int) -> str:
        """`longest`: characters."""
        return _text(name, self._members.get(name), longest)

    def text_or_none(self, name: str, longest: int) -> str | None:
        """Returns None for null and for a member that is missing."""
        return None if self._members.get(name) is None else self.text(name, longest)

    def texts(self, name: str, most: int, longest: int) -> frozenset[str]:
        """`most`: texts of at most `longest` characters."""
        found = self._members.get(name)
        if not isinstance(found, list) or len(found) > most:
            raise BadValue(f"{name} is no list of at most {most} texts")
        return frozenset(_text(name, one, longest) for one in found)


def _text(name: str, found: object, longest: int) -> str:
    if not isinstance(found, str) or len(found) > longest:
        raise BadValue(f"{name} is no text of at most {longest} characters")
    return found
