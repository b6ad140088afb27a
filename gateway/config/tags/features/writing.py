"""The permission to write a tag, with its rules."""

from collections.abc import Iterator
from typing import Annotated, Any, Self

from pydantic import Discriminator, model_validator
from pydantic import Tag as Choice

from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Finite
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings
from gateway.errors import BadValue
from gateway.tags import Tag, WriteRule
from gateway.values import BYTES, ValueType


class WriteSection(Section):
    """The rules for writing a tag."""

    min: Finite | None = None
    """The least value, in the unit of the tag."""
    max: Finite | None = None
    """The greatest value, in the unit of the tag."""
    verify: bool = False
    """Read back after the acknowledgement and compare."""
    repeat: bool = False
    """Send the write again after an unclear result."""
    latest: bool = False
    """Of several waiting writes, send only the last."""

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:.15g} is above max {self.max:.15g}")
        return self


def _shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, WriteSection)) else "flag"


class WriteSettings(Settings):
    write: Annotated[
        Annotated[bool, Choice("flag")] | Annotated[WriteSection, Choice("rule")],
        Discriminator(_shape),
    ] = False
    """Permission to write the tag, with its rules."""
    poll: bool = True
    """False: the tag is written, and never read."""


def needs_write(own: Any, facts: Facts) -> Iterator[Problem]:
    """Yields what is wrong with a tag that is written, never read."""
    area, field, rule = facts.area, facts.field, facts.write
    if area is not None and not area.readable:
        never = f"{facts.name} is never read at station {facts.station}"
        if rule is None:
            yield "write", f"{never}: it needs write: true"
        if facts.bit is not None or facts.kind.kind in BYTES:
            yield "address", f"{never}: write the whole word"
        if rule is not None and rule.verify:
            yield "write", f"{never}: verify cannot work"
    if field is not None and not field.polled:
        if "every" in own.model_fields_set:
            yield "every", f"{facts.name} is never polled: it has no interval"
        if not field.unsolicited and rule is None:
            yield "write", f"{facts.name} can only be written: it needs write: true"
        if isinstance(own.write, WriteSection) and own.write.verify:
            yield "write", f"{facts.name} cannot be read back, no request reads it: remove verify"


def rule_of(setting: bool | WriteSection, kind: ValueType, *, polled: bool = True) -> WriteRule:
    """Returns the rule of `write:` for a tag that can be written."""
    if not isinstance(setting, WriteSection):
        return WriteRule(polled=polled)
    number = kind.is_number
    return WriteRule(
        min=setting.min if number else None,
        max=setting.max if number else None,
        verify=setting.verify,
        repeat=setting.repeat,
        latest=setting.latest,
        polled=polled,
    )


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    rule = own.write
    if not own.poll:
        if facts.write is None:
            yield "poll", f"{facts.name} is not written either: it needs write: true"
        if facts.bit is not None or facts.kind.kind in BYTES:
            yield "poll", f"a write of {facts.name} reads its word: write the whole word"
        if isinstance(rule, WriteSection) and rule.verify:
            yield "poll", f"{facts.name} cannot be read back: remove verify"
    if not isinstance(rule, WriteSection) or rule.min is rule.max is None:
        return
    if facts.write is not None and not facts.kind.is_number:
        yield "write", f"a {facts.kind} has no min and max: only numbers have"


def check_bounds(own: Any, tag: Tag) -> Iterator[Problem]:
    """Yields a bound that the device cannot hold: the first write with it would be refused."""
    if tag.write is None or "write" not in own.model_fields_set:
        return
    for setting in ("min", "max"):
        bound = getattr(tag.write, setting)
        if bound is None:
            continue
        try:
            (tag.element or tag).encode(int(bound) if bound == int(bound) else bound)
        except BadValue as error:
            yield setting, str(error)


def _meta(tag: Tag) -> dict[str, object]:
    rule = tag.write
    limits = None if rule is None else {"min": rule.min, "max": rule.max, "verify": rule.verify}
    return {"write": limits}


FEATURE = Feature(defaults=WriteSettings, check=_check, meta=_meta)
