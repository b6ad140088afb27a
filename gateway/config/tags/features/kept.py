"""Makes tags whose value follows from several reads: `debounce` and `counter`."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any

from pydantic import Discriminator, Field
from pydantic import Tag as Choice

from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Duration
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings, for_one
from gateway.tags import Origin, Publish, Tag
from gateway.tags.publishing import ON_CHANGE
from gateway.tags.shaping import PLAIN, Shaping
from gateway.tags.tag import CounterRule
from gateway.values import Kind, Layout, ValueType

_DIGITS = {Kind.BCD16: 4, Kind.BCD32: 8}
_EACH_READ = ("heartbeat", "publish", "event", "write")


class CounterSection(Section):
    """A counter of the device that begins again at 0; left out: as wide as its type."""

    bits: Annotated[int, Field(ge=1, le=64)] | None = None
    """The width of the counter."""
    top: Annotated[int, Field(ge=1, le=2**63 - 1)] | None = None
    """The greatest count, such as 9999; instead of `bits`."""
    most: Annotated[int, Field(ge=1, le=2**63 - 1)] | None = None
    """The greatest step from one read to the next; more is no count. Left out: half the range."""


def _shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, CounterSection)) else "flag"


class DebounceSettings(Settings):
    debounce: Duration = 0.0
    """A bit changes after it had the new value for this time; 0s: at once."""


class CounterSettings(Settings):
    counter: Annotated[
        Annotated[bool, Choice("flag")] | Annotated[CounterSection, Choice("rule")],
        Discriminator(_shape),
    ] = False
    """The total of a counter that begins again at 0."""


def _rule(own: Any) -> CounterSection:
    return own.counter if isinstance(own.counter, CounterSection) else CounterSection()


def _wrap(own: Any, settings: Any, tag: Tag) -> Tag:
    """Returns the tag; with `debounce` or `counter` around another tag that has its raw reads."""
    if own.counter:
        return _counted(tag, _rule(own))
    is_bit = tag.layout.type == ValueType(Kind.BOOL)
    if settings.debounce and is_bit and tag.write is None and not tag.publishing.event:
        return _around(tag, tag.layout, settings.debounce, replace(tag.shaping, names=None))
    return tag


def _around(tag: Tag, layout: Layout, rule: float | CounterRule, shaping: Shaping) -> Tag:
    """Returns a tag around the tag that is read, of which nothing is published.

    `shaping`: of the tag that is read.
    """
    raw = replace(tag, publishing=ON_CHANGE, shaping=shaping, features=())
    publishing = replace(tag.publishing, heartbeat=None, publish=Publish.CHANGE)
    origin = Origin(kept=rule, inputs=(raw,))
    return replace(tag, layout=layout, origin=origin, publishing=publishing)


def _counted(tag: Tag, rule: CounterSection) -> Tag:
    kind = tag.layout.type
    modulus = 10 ** _DIGITS[kind.kind] if kind.kind in _DIGITS else 2**kind.bits
    if rule.bits is not None:
        modulus = 2**rule.bits
    if rule.top is not None:
        modulus = rule.top + 1
    kept = CounterRule(modulus, modulus // 2 if rule.most is None else rule.most)
    shaping = replace(tag.shaping, range=None)
    return _around(replace(tag, shaping=shaping), Layout(ValueType(Kind.INT64)), kept, PLAIN)


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    kind, debounced = facts.kind, "debounce" in own.model_fields_set and own.debounce
    if kind.count:
        yield from for_one(own, kind, "debounce", "counter")
        return
    if debounced and kind.kind is not Kind.BOOL:
        yield "debounce", f"a {kind} has no debounce: only bits have; for numbers use deadband"
    if own.counter and (not kind.is_number or kind.is_float):
        yield "counter", f"a {kind} has no counter: only whole numbers have"
    elif own.counter:
        yield from _counter_misfits(own, kind)
    for setting in _EACH_READ:
        default = type(own).model_fields[setting].default
        if (debounced or own.counter) and getattr(own, setting) != default:
            what = "a debounced bit" if debounced else "a total"
            why = "cannot be written" if setting == "write" else "is published when it changes"
            yield setting, f"{what} {why}: remove {setting}"


def _counter_misfits(own: Any, kind: ValueType) -> Iterator[Problem]:
    rule = _rule(own)
    if rule.bits is not None and rule.top is not None:
        yield "counter", "bits and top say the same: remove one of them"
    if own.enum is not None:
        yield "enum", "a total has no names"
    if "range" in own.model_fields_set:
        yield "range", "a total has no range: no sensor measures it"
    if rule.top is not None and not kind.holds(rule.top):
        yield "counter", f"{rule.top} is no value of a {kind}"
    if rule.bits is not None and rule.bits > kind.bits:
        yield "counter", f"a {kind} has no {rule.bits} bits"


def _meta(tag: Tag) -> dict[str, object]:
    kept = tag.origin.kept
    return {
        "debounce": kept if isinstance(kept, float) else None,
        "counter": kept._asdict() if isinstance(kept, CounterRule) else None,
    }


FEATURE = Feature(
    defaults=DebounceSettings, own=CounterSettings, check=_check, wrap=_wrap, meta=_meta
)
