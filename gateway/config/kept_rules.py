"""Makes tags whose value follows from several reads: `debounce` and `counter`."""

from collections.abc import Iterator
from dataclasses import replace

from gateway.config.messages import Mistakes, Path
from gateway.config.model import TagDefaults, TagSection
from gateway.config.shaping_settings import CounterSection
from gateway.tags import Origin, Publish, Tag
from gateway.tags.publishing import ON_CHANGE
from gateway.tags.shaping import PLAIN, Shaping
from gateway.tags.tag import CounterRule
from gateway.values import Kind, Layout, ValueType

_DIGITS = {Kind.BCD16: 4, Kind.BCD32: 8}
_EACH_READ = ("heartbeat", "publish", "event", "write")


def kept_tag(
    own: TagSection, settings: TagDefaults, tag: Tag, path: Path, mistakes: Mistakes
) -> Tag:
    """Returns the tag; with `debounce` or `counter` around another tag that has its raw reads."""
    counter, kind = own.counter, tag.layout.type
    wrong = list(_misfits(own, kind))
    for setting, problem in wrong:
        mistakes.add((*path, setting), problem)
    if wrong:
        return tag
    if counter:
        return _counted(tag, counter if isinstance(counter, CounterSection) else CounterSection())
    fits = kind == ValueType(Kind.BOOL) and tag.write is None and not tag.publishing.event
    if settings.debounce and fits:
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
    return _around(tag, Layout(ValueType(Kind.INT64)), kept, PLAIN)


def _misfits(own: TagSection, kind: ValueType) -> Iterator[tuple[str, str]]:
    """Yields settings with their mistake."""
    debounced = bool(own.debounce)
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


def _counter_misfits(own: TagSection, kind: ValueType) -> Iterator[tuple[str, str]]:
    rule = own.counter if isinstance(own.counter, CounterSection) else CounterSection()
    if rule.bits is not None and rule.top is not None:
        yield "counter", "bits and top say the same: remove one of them"
    if own.enum is not None:
        yield "enum", "a total has no names"
    if rule.top is not None and not kind.holds(rule.top):
        yield "counter", f"{rule.top} is no value of a {kind}"
    if rule.bits is not None and rule.bits > kind.bits:
        yield "counter", f"a {kind} has no {rule.bits} bits"
