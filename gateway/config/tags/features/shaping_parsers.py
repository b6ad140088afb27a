"""Parsers of the settings that shape a value. Each raises `ConfigError` with a correct example."""

import math
import re
from typing import Any

from gateway.config.messages import shown
from gateway.errors import ConfigError
from gateway.tags.shaping import Bounds, Names

_WHOLE = re.compile(r"-?[0-9]{1,20}\Z")
_NUMBER = re.compile(r"[-+]?[0-9.]+\Z")


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return value if math.isfinite(value) else None


def pair(value: object) -> tuple[float, float]:
    """Parses `[4, 20]`."""
    found = [_number(one) for one in value] if isinstance(value, list) else []
    if len(found) != 2 or found[0] is None or found[1] is None:
        raise ConfigError(f"{shown(value)}: write the two ends, such as [4, 20]")
    if found[0] == found[1]:
        raise ConfigError(f"{shown(found[0])} twice: the two ends must differ, such as [4, 20]")
    return found[0], found[1]


def bounds(value: object) -> Bounds:
    """Parses `[0, 100]` and `[0, null]`."""
    ends = value if isinstance(value, list) and len(value) == 2 else []
    found = [_number(one) for one in ends]
    if not ends or any(one is not None and _number(one) is None for one in ends):
        raise ConfigError(
            f"{shown(value)}: write the least and the greatest value, such as [0, 100] or [0, null]"
        )
    low, high = found
    if low is high is None:
        raise ConfigError("write a least or a greatest value, such as [0, null]")
    if low is not None and high is not None and low >= high:
        raise ConfigError(f"{shown(low)} is not below {shown(high)}: write [0, 100]")
    return Bounds(low, high)


def names(value: object) -> Names:
    """Parses `{0: off, 1: auto}`."""
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"{shown(value)}: write numbers with names, such as {{0: off, 1: auto}}")
    found, taken = dict[int, str](), set[str]()
    for key, name in value.items():
        if not _WHOLE.match(key):
            raise ConfigError(f"{key!r} is no whole number: write {{0: off, 1: auto}}")
        if not isinstance(name, str) or not name.strip() or _NUMBER.match(name):
            raise ConfigError(f"{key}: {shown(name)} is no name: write a word, true in quotes")
        if int(key) in found:
            raise ConfigError(f"{int(key)} is there twice")
        if name in taken:
            raise ConfigError(f"{name} is there twice: a write of the name would not be clear")
        found[int(key)] = name
        taken.add(name)
    return Names(found)


def bits(value: object) -> dict[int, str | dict[str, Any]]:
    """Parses `{0: pump, 3: {name: fault, invert: true}}`."""
    if not isinstance(value, dict) or not value:
        raise ConfigError(f"{shown(value)}: write bits with names, such as {{0: pump, 3: fault}}")
    found: dict[int, str | dict[str, Any]] = {}
    for key, entry in value.items():
        if not key.isdecimal() or int(key) > 15:
            raise ConfigError(f"{key!r} is no bit of a word: they have the numbers 0 to 15")
        if int(key) in found:
            raise ConfigError(f"bit {int(key)} is there twice")
        name = entry.get("name") if isinstance(entry, dict) else entry
        if not isinstance(name, str):
            raise ConfigError(f"bit {key} has no name: write {key}: pump, or {key}: {{name: pump}}")
        found[int(key)] = entry
    return found
