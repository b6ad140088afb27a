"""Prepares the settings of a protocol for pydantic: durations in seconds, no unknown names.

Settings may be nested, and pydantic would ignore unknown names in a nested dataclass.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_type_hints

from gateway.config.messages import Mistakes, Path, meant
from gateway.config.settings import parsers
from gateway.errors import ConfigError

_LEFT_OUT = object()


def plain_settings(
    kind: type[Any], raw: Mapping[str, Any], path: Path, mistakes: Mistakes
) -> dict[str, Any]:
    """Returns the settings of a dataclass without mistakes, and notes those."""
    hints = get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]
    found: dict[str, Any] = {}
    for name, value in raw.items():
        if name not in known:
            owner = path[-1] if path else "the file"
            mistakes.add((*path, name), f"no setting of {owner}: {meant(name, known)}")
            continue
        plain = _plain(hints[name], value, (*path, name), mistakes)
        if plain is not _LEFT_OUT:
            found[name] = plain
    return found


def is_duration(hint: Any) -> bool:
    """Every float among the settings of a protocol is a time."""
    return float in (hint, *get_args(hint))


def dataclasses_in(kind: type[Any]) -> Iterator[type[Any]]:
    """The dataclasses among the settings of a dataclass, to any depth."""
    hints = get_type_hints(kind)
    for hint in (hints[field.name] for field in dataclasses.fields(kind) if field.init):
        for part in (hint, *get_args(hint)):
            if isinstance(part, type) and dataclasses.is_dataclass(part):
                yield part
                yield from dataclasses_in(part)


def _plain(hint: Any, value: Any, path: Path, mistakes: Mistakes) -> Any:
    if is_duration(hint):
        try:
            return value if value is None else parsers.duration(value)
        except ConfigError as error:
            mistakes.add(path, str(error))
            return _LEFT_OUT
    if not isinstance(value, dict):
        return _number(hint, value, path)
    inner = _dataclass_in(hint)
    if inner is None:
        return value
    if _by_name(hint):
        each = {name: (one, (*path, name)) for name, one in value.items()}
        return {
            name: plain_settings(inner, one, place, mistakes) if isinstance(one, dict) else one
            for name, (one, place) in each.items()
        }
    return plain_settings(inner, value, path, mistakes)


def _number(hint: Any, value: Any, path: Path) -> Any:
    """Converts a `format` that is a number: the file reader takes every `format` as a text."""
    whole = int in (hint, *get_args(hint)) and path[-1] == "format"
    return int(value) if whole and isinstance(value, str) and value.isdecimal() else value


def _by_name(hint: Any) -> bool:
    return getattr(hint, "__origin__", None) is Mapping


def _dataclass_in(hint: Any) -> type[Any] | None:
    for part in (hint, *get_args(hint)):
        if isinstance(part, type) and dataclasses.is_dataclass(part):
            return part
    return None
