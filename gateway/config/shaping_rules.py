"""Makes the shaping of a tag: checks that its settings fit the value and each other."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

from gateway.config.messages import shown
from gateway.config.model import ComputedSection, TagDefaults, TagSection
from gateway.tags.scaling import Ends, decimal, linear, type_of
from gateway.tags.shaping import PLAIN, Bounds, Names, Shaping
from gateway.values import BYTES, Kind, ValueType


def shaping_of(
    own: TagSection, settings: TagDefaults, kind: ValueType, mistakes: list[tuple[str, str]]
) -> Shaping:
    """Returns the shaping of a value; adds settings with mistakes.

    `settings`: those of the tag with those that it inherits. Of these one that does not fit is
    ignored.
    """
    ends = None
    if kind.is_number and settings.from_ is not None and settings.to is not None:
        ends = Ends(settings.from_, settings.to)
    scaling = (settings.scale, settings.offset) if kind.is_number else (1.0, 0.0)
    line = linear(*scaling, ends)
    value_type = type_of(kind, line)
    whole = not value_type.startswith("float")
    found = Shaping(
        scale=scaling[0],
        offset=scaling[1],
        ends=ends,
        decimals=settings.decimals if kind.is_number and not whole else None,
        clamp=settings.clamp if kind.is_number else None,
        invert=own.invert,
        names=own.enum,
    )
    wrong = [
        *_misfits(own, kind, value_type, scaled=line is not None),
        *_clamp_misfits(found, whole=whole),
    ]
    mistakes += [(place, what) for place, what in wrong if place in own.model_fields_set]
    if any(place == "clamp" for place, _ in wrong):
        found = replace(found, clamp=None)
    return _shared(found)


@lru_cache(maxsize=4096)
def _shared(shaping: Shaping) -> Shaping:
    """Returns one object for all that are equal."""
    return PLAIN if shaping == PLAIN else shaping


def computed_shaping(
    own: ComputedSection, settings: TagDefaults, mistakes: list[tuple[str, str]], *, whole: bool
) -> Shaping:
    """Returns the shaping of a computed value. See `shaping_of`."""
    found = Shaping(decimals=None if whole else settings.decimals, clamp=settings.clamp)
    wrong = list(_clamp_misfits(found, whole=whole))
    if whole and own.decimals is not None:
        wrong.append(("decimals", "the values are whole numbers: decimals changes nothing"))
    mistakes += [(place, what) for place, what in wrong if place in own.model_fields_set]
    if any(place == "clamp" for place, _ in wrong):
        found = Shaping(decimals=found.decimals)
    return found


def _misfits(
    own: TagSection, kind: ValueType, value_type: str, *, scaled: bool
) -> Iterator[tuple[str, str]]:
    """Yields settings that the type of the tag cannot have."""
    if own.invert and kind.kind is not Kind.BOOL:
        yield "invert", f"a {kind} cannot be inverted: only a bit can; for numbers use scale: -1"
    if own.byte is not None and kind.kind not in BYTES:
        yield "byte", f"a {kind} has whole words: byte needs type: uint8 or int8"
    if not kind.is_number:
        for place, setting in (("from_", "from"), ("decimals", "decimals"), ("clamp", "clamp")):
            yield place, f"a {kind} has no {setting}: only numbers have"
    elif own.decimals is not None and not value_type.startswith("float"):
        why = f"the values are whole numbers ({value_type})"
        yield "decimals", f"{why}: if 123 in the device is 12.3, write scale: 0.1"
    if own.enum is not None:
        yield from _enum_misfits(own, own.enum, kind, scaled=scaled)


def _enum_misfits(
    own: TagSection, names: Names, kind: ValueType, *, scaled: bool
) -> Iterator[tuple[str, str]]:
    if kind.kind is Kind.STRING or kind.is_float:
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
    if kind.kind is Kind.BOOL:
        return number in (0, 1)
    return kind.holds(number)


def _clamp_misfits(found: Shaping, *, whole: bool) -> Iterator[tuple[str, str]]:
    """Yields a clamp with limits that no value can have."""
    limits = [limit for limit in found.clamp or Bounds() if limit is not None]
    places = 0 if whole else found.decimals
    for limit in limits:
        if places is not None and round(decimal(limit), places) != decimal(limit):
            why = "the values are whole numbers" if whole else f"the values have {places} decimals"
            yield "clamp", f"{shown(limit)} is no limit here: {why}"
