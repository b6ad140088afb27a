"""Bits of a word as tags of their own: `bits: {0: pump, 3: fault}`."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from gateway.config.messages import Mistakes, Path
from gateway.config.settings.setting_types import Parsed
from gateway.config.tags.features import shaping_parsers
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings
from gateway.errors import ConfigError
from gateway.protocols.driver import Addressing, Unit
from gateway.protocols.typed_fields import TypedFields

_SCHEMA = {
    "type": "object",
    "propertyNames": {"pattern": "^([0-9]|1[0-5])$"},
    "additionalProperties": {"type": ["string", "object"]},
    "minProperties": 1,
}
Rows = Iterator[tuple[str, object, Path]]


class BitsSettings(Settings):
    bits: Annotated[dict[int, Any] | None, Parsed(shaping_parsers.bits, _SCHEMA)] = None
    """One tag for each named bit of the word, instead of the word: {0: pump, 3: fault}."""


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    if facts.field is not None:
        yield "bits", f"the field {facts.name} has its own type: remove bits here"


FEATURE = Feature(own=BitsSettings, check=_check)


def with_bits(rows: Mapping[str, object], driver: Addressing | None, mistakes: Mistakes) -> Rows:
    """Yields name, settings and place below `tags` of each tag; of a tag with bits, of each bit."""
    for name, raw in rows.items():
        if isinstance(raw, dict) and "bits" in raw and driver is not None:
            yield from _bits(name, raw, driver, mistakes.at(name))
        else:
            yield name, raw, (name,)


def _bits(name: str, raw: Mapping[str, Any], driver: Addressing, mistakes: Mistakes) -> Rows:
    try:
        bits = shaping_parsers.bits(raw["bits"])
    except ConfigError as error:
        mistakes.add(str(error), "bits")
        return
    rest = {setting: value for setting, value in raw.items() if setting != "bits"}
    try:
        address = driver.address(str(raw.get("address", "")))
    except ConfigError:
        yield name, rest, (name,)  # its mistake is found there
        return
    if isinstance(driver, TypedFields):
        mistakes.add("a field of a frame has no bits: declare fields of one bit", "bits")
        return
    if address.bit is not None or driver.areas[address.area].unit is not Unit.WORD:
        spelt = driver.spell(address)
        mistakes.add(f"{spelt} is no word of 16 bits: remove bits", "bits")
        return
    for bit, entry in bits.items():
        own = {"name": entry} if isinstance(entry, str) else dict(entry)
        inner = (name,) if isinstance(entry, str) else (name, "bits", str(bit))
        spelt = driver.spell(address._replace(bit=bit))
        yield f"{name}/{own.pop('name')}", {**rest, **own, "address": spelt}, inner
