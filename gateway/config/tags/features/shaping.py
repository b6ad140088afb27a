"""The way from the number of the device to the value: docs/shaping.md."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from gateway.config.messages import shown
from gateway.config.settings import parsers
from gateway.config.settings.setting_types import SCALE_SCHEMA, Finite, Parsed
from gateway.config.tags.features import shaping_parsers
from gateway.config.tags.features.feature import (
    Facts,
    Feature,
    Problem,
    Settings,
    for_numbers,
    for_one,
)
from gateway.tags import Tag
from gateway.tags.scaling import Ends, decimal, linear, type_of
from gateway.tags.shaping import PLAIN, Bounds, Names, Shaping
from gateway.values import Kind, ValueType

_PAIR_SCHEMA: dict[str, Any] = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 2,
    "maxItems": 2,
}
_CLAMP_SCHEMA = _PAIR_SCHEMA | {"items": {"type": ["number", "null"]}}
_ENUM_SCHEMA = {
    "type": "object",
    "propertyNames": {"pattern": "^-?[0-9]+$"},
    "additionalProperties": {"type": "string"},
    "minProperties": 1,
}
_Bounds = Annotated[Bounds, Parsed(shaping_parsers.bounds, _CLAMP_SCHEMA)]
_Pair = Annotated[tuple[float, float], Parsed(shaping_parsers.pair, _PAIR_SCHEMA)]


class ScalingSettings(Settings):
    scale: Annotated[Finite, AfterValidator(parsers.scale), WithJsonSchema(SCALE_SCHEMA)] = 1.0
    """value = raw x scale + offset"""
    offset: Finite = 0.0
    """value = raw x scale + offset"""
    from_: _Pair | None = Field(default=None, alias="from")
    """Two values of the device, such as [4, 20]; `to` has the values of the tag there."""
    to: _Pair | None = None
    """The values of the tag at the two ends of `from`, such as [0, 100]; instead of scale."""
    decimals: Annotated[int, Field(ge=0, le=15)] | None = None
    """A read is rounded to so many decimals, and so is a write."""
    clamp: _Bounds | None = None
    """A read outside is shown as the nearest end, such as [0, 100] or [0, null]."""
    range: _Bounds | None = None
    """The range of the sensor, such as [0, 100] or [0, null]: a read outside is uncertain."""

    @model_validator(mode="after")
    def _both_ends(self) -> Self:
        if (self.from_ is None) is not (self.to is None):
            raise ValueError("from and to belong together: from: [4, 20] and to: [0, 100]")
        other = self.model_fields_set & {"scale", "offset"}
        if self.from_ is not None and other:
            raise ValueError(f"from and to replace scale and offset: remove {min(other)}")
        return self


class ShapingSettings(Settings):
    enum: Annotated[Names, Parsed(shaping_parsers.names, _ENUM_SCHEMA)] | None = None
    """Names of the values, such as {0: off, 1: auto}; a write takes the number or the name."""
    invert: bool = False
    """The bit is shown and written the other way round."""


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    kind = facts.kind
    shaping, value_type = _shaping(own, facts)
    if facts.area is not None or facts.field is not None:
        numbers = ("scale", "offset", "from_", "decimals", "clamp", "range")
        yield from for_numbers(own, kind, *numbers)
        yield from for_one(own, kind, "enum")
        if own.invert and kind.kind is not Kind.BOOL:
            yield (
                "invert",
                f"a {kind} cannot be inverted: only a bit can; for numbers use scale: -1",
            )
        if own.enum is not None and not kind.count:
            yield from _enum_misfits(own, own.enum, kind, scaled=shaping.line is not None)
    whole = facts.whole or not value_type.startswith("float")
    if "decimals" in own.model_fields_set and whole and kind.is_number:
        why = f"the values are whole numbers ({value_type}): if 123 in the device is 12.3, write"
        computed = "the values are whole numbers: decimals changes nothing"
        yield "decimals", computed if facts.whole else f"{why} scale: 0.1"
    if "clamp" in own.model_fields_set:
        for what in _clamp_misfits(shaping, whole=whole):
            yield "clamp", what


def _enum_misfits(own: Any, names: Names, kind: ValueType, *, scaled: bool) -> Iterator[Problem]:
    if kind.is_text or kind.is_float:
        yield "enum", f"a {kind} has no enum: only bits and whole numbers have"
    elif scaled:
        yield "enum", "an enum names the numbers of the device: remove scale, offset, from and to"
    elif wrong := [number for number in names.by_number if not _fits(number, kind)]:
        yield "enum", f"{wrong[0]} is no value of a {kind}"
    if own.deadband is not None and "deadband" in own.model_fields_set:
        yield "enum", "a value with names has no deadband: each change is another state"
    if own.clamp is not None:
        yield "enum", "a value with names has no clamp: it would show another state"


def _fits(number: int, kind: ValueType) -> bool:
    return number in (0, 1) if kind.kind is Kind.BOOL else kind.holds(number)


def _clamp_misfits(found: Shaping, *, whole: bool) -> Iterator[str]:
    """Yields what is wrong with a clamp that has limits which no value can have."""
    places = 0 if whole else found.decimals
    for limit in found.clamp or Bounds():
        if limit is None or places is None or round(decimal(limit), places) == decimal(limit):
            continue
        why = "the values are whole numbers" if whole else f"the values have {places} decimals"
        yield f"{shown(limit)} is no limit here: {why}"


def _shaping(own: Any, facts: Facts) -> tuple[Shaping, str]:
    """Returns the shaping, perhaps with a clamp that does not fit, and the type of the value."""
    settings, kind = facts.settings, facts.kind
    if facts.area is None and facts.field is None:  # of a computed tag
        decimals = None if facts.whole else settings.decimals
        return Shaping(decimals=decimals, clamp=settings.clamp, range=settings.range), str(kind)
    found, value_type = (
        (PLAIN, str(kind))
        if not kind.is_number
        else _of_number(
            kind,
            settings.scale,
            settings.offset,
            None if settings.to is None else Ends(settings.from_, settings.to),
            settings.decimals,
            settings.clamp,
            settings.range,
        )
    )
    if own.invert or own.enum is not None:
        return replace(found, invert=own.invert, names=own.enum), value_type
    return found, value_type


@lru_cache(maxsize=4096)
def _of_number(
    kind: ValueType,
    scale: float,
    offset: float,
    ends: Ends | None,
    decimals: int | None,
    clamp: Bounds | None,
    sensor: Bounds | None,
) -> tuple[Shaping, str]:
    """Returns one object for all that are equal."""
    value_type = type_of(kind, linear(scale, offset, ends))
    found = Shaping(
        scale=scale,
        offset=offset,
        ends=ends,
        decimals=decimals if value_type.startswith("float") else None,
        clamp=clamp,
        range=sensor,
    )
    return PLAIN if found == PLAIN else found, value_type


def _make(own: Any, facts: Facts) -> Shaping:
    found, value_type = _shaping(own, facts)
    whole = facts.whole or not value_type.startswith("float")
    if found.clamp is not None and any(_clamp_misfits(found, whole=whole)):
        return replace(found, clamp=None)
    return found


def _meta(tag: Tag) -> dict[str, object]:
    shaping = tag.shaping
    names = None if shaping.names is None else shaping.names.by_number
    return {
        "scale": shaping.scale,
        "offset": shaping.offset,
        "from": None if shaping.ends is None else shaping.ends.raw,
        "to": None if shaping.ends is None else shaping.ends.value,
        "decimals": shaping.decimals,
        "clamp": _limits(shaping.clamp),
        "range": _limits(shaping.range),
        "invert": shaping.invert,
        "enum": None if names is None else {str(number): name for number, name in names.items()},
    }


def _limits(bounds: Bounds | None) -> dict[str, float | None] | None:
    return None if bounds is None else {"min": bounds.low, "max": bounds.high}


FEATURE = Feature(
    defaults=ScalingSettings,
    own=ShapingSettings,
    computed=frozenset({"decimals", "clamp", "range"}),
    check=_check,
    make=_make,
    slot="shaping",
    meta=_meta,
)
