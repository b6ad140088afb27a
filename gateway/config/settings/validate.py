"""Validates with pydantic, and words its findings for a plant engineer."""

import dataclasses
import json
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from gateway.config.messages import Mistakes, Path, meant, one_of, shown
from gateway.config.settings import parsers
from gateway.config.settings.session_model import Section
from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver
from gateway.protocols.registry import PROTOCOLS, Protocol

S = TypeVar("S", bound=Section)

# The branches of `write:` and others: pydantic names them in its places, the file does not.
_BRANCHES = ("flag", "rule")


def section(kind: type[S], raw: object, mistakes: Mistakes, called: str) -> S | None:
    """Returns the section without its mistakes; None if that is impossible."""
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        rest = raw
        for detail in error.errors():
            place = tuple(chunk for chunk in detail["loc"] if chunk not in _BRANCHES)
            mistakes.add(_sentence(detail, called, _known(kind, place[:-1])), *place)
            rest = _without(rest, place)
    try:
        return kind.model_validate(rest)
    except ValidationError:
        return None


def _without(raw: Any, place: Path) -> Any:
    """Copies the settings without the one at `place`; removes a list with a mistake as a whole."""
    if not isinstance(raw, dict) or not place or place[0] not in raw:
        return raw
    rest = dict(raw)
    inner = rest.pop(str(place[0]))
    if len(place) > 1 and isinstance(inner, dict):
        rest[str(place[0])] = _without(inner, place[1:])
    return rest


def driver_of(protocol: str, settings: Mapping[str, Any], mistakes: Mistakes) -> AnyDriver | None:
    """Returns the driver with these settings; with mistakes, one with the correct settings."""
    before = len(mistakes)
    kind = PROTOCOLS[protocol].settings
    values = plain_settings(kind, settings, mistakes)
    nested = any(dataclasses_in(kind))
    if nested and len(mistakes) > before:
        return None  # the rest cannot be checked without the part that is wrong
    try:
        return _driver(protocol, values)
    except ValidationError as error:
        for detail in error.errors():
            place = detail["loc"]
            owner = str(place[-2]) if len(place) > 1 else f"a {protocol} device"
            text = _sentence(detail, owner, ())
            first = text.split(maxsplit=1)[0].rstrip(":,")
            if not place and first in values:
                place, text = (first,), text.removeprefix(f"{first}: ")
            mistakes.add(text, *place)
            values.pop(str(place[0]) if place else "station", None)
    if nested:
        return None
    try:
        return _driver(protocol, values)
    except ValidationError:
        return None


def driver_settings(protocol: str) -> set[str]:
    """Returns the names of its own settings in the file."""
    return {field.name for field in dataclasses.fields(PROTOCOLS[protocol].settings) if field.init}


def _driver(protocol: str, values: Mapping[str, Any]) -> AnyDriver:
    # As JSON, because pydantic is strict there (true is no number) and still builds dataclasses.
    text = json.dumps({"protocol": protocol, **values}, default=str)
    known = PROTOCOLS[protocol]
    return known.driver(_adapter(known).validate_json(text, strict=True))


@cache
def _adapter(known: Protocol) -> TypeAdapter[Any]:
    return TypeAdapter(known.settings)


def _known(kind: type[BaseModel], place: Path) -> Collection[str]:
    """Returns the settings at a place inside a section."""
    chunks = iter(place)
    for chunk in chunks:
        annotation = kind.model_fields[str(chunk)].annotation
        inner = _inner(annotation)
        if inner is None:
            return ()
        if get_origin(annotation) in (dict, list):
            next(chunks, None)  # the name or number of one of several sections
        kind = inner
    return settings_of(kind)


def settings_of(kind: type[BaseModel]) -> list[str]:
    """Returns the names of the settings as the file writes them."""
    return [field.alias or name for name, field in kind.model_fields.items()]


def _inner(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type):
        return annotation if issubclass(annotation, BaseModel) else None
    return next(filter(None, map(_inner, get_args(annotation))), None)


_FLAGS = {
    "write": "true, false or {min: 0, max: 100, verify: true}",
    "counter": "true, or {bits: 16, most: 1000}",
    **dict.fromkeys(("devices", "lines", "transfers"), "true, false or {delay: 10s}"),
}
_NOT = {
    "bool_type": "is neither true nor false",
    "int_type": "is no whole number",
    "int_from_float": "is no whole number",
    "float_type": "is no number",
    "finite_number": "is no number that can be used",
    "string_type": "is no text: put it in quotes",
    "list_type": "is no list: write it as [first, second]",
    "tuple_type": "is no list: write it as [first, second]",
    "dict_type": "stands where settings are expected, each as `name: value`",
    "dataclass_type": "stands where settings are expected, each as `name: value`",
    "model_type": "stands where settings are expected, each as `name: value`",
}


def _sentence(detail: ErrorDetails, called: str, known: Collection[str]) -> str:
    value, context = shown(detail["input"]), detail.get("ctx", {})
    match detail["type"]:
        case "missing":
            return f"missing: {called} needs it"
        case "extra_forbidden":
            place = [chunk for chunk in detail["loc"] if chunk not in _BRANCHES]
            owner = str(place[-2]) if len(place) > 1 else called
            return unknown(str(place[-1]), owner, known)
        case "value_error":
            return str(context["error"])
        case "bool_type" if "flag" in detail["loc"]:
            return f"{value}: write {_FLAGS[str(detail['loc'][-2])]}"
        case "literal_error" | "enum":
            choices = str(context["expected"]).replace("'", "")
            return f"{value} is not known: use {choices}"
        case "greater_than_equal":
            return f"{value} is below {context['ge']}"
        case "less_than_equal":
            return f"{value} is above {context['le']}"
        case "float_type" if number := parsers.with_point(detail["input"]):
            return f"{value} is no number: write {number}"
        case other if other in _NOT:
            return f"{value} {_NOT[other]}"
    return f"{value}: {detail['msg']}"


def unknown(name: str, owner: str, known: Collection[str]) -> str:
    return f"no setting of {owner}: {meant(name, known)}" if known else f"no setting of {owner}"


def protocols() -> str:
    return one_of(PROTOCOLS)


_LEFT_OUT = object()


def plain_settings(kind: type[Any], raw: Mapping[str, Any], mistakes: Mistakes) -> dict[str, Any]:
    """Returns the settings of a dataclass without mistakes, and notes those."""
    hints = get_type_hints(kind)
    known = [field.name for field in dataclasses.fields(kind) if field.init]
    found: dict[str, Any] = {}
    for name, value in raw.items():
        if name not in known:
            owner = mistakes.path[-1] if mistakes.path else "the file"
            mistakes.add(f"no setting of {owner}: {meant(name, known)}", name)
            continue
        plain = _plain(hints[name], value, mistakes.at(name))
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


def _plain(hint: Any, value: Any, mistakes: Mistakes) -> Any:
    if is_duration(hint):
        try:
            return value if value is None else parsers.duration(value)
        except ConfigError as error:
            mistakes.add(str(error))
            return _LEFT_OUT
    if not isinstance(value, dict):
        return _number(hint, value, mistakes.path)
    inner = _dataclass_in(hint)
    if inner is None:
        return value
    if _by_name(hint):
        return {
            name: plain_settings(inner, one, mistakes.at(name)) if isinstance(one, dict) else one
            for name, one in value.items()
        }
    return plain_settings(inner, value, mistakes)


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
