"""Makes tags: checks that the device has the address and that all settings fit."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

from gateway.config.messages import Mistakes
from gateway.config.tags.features.feature import Facts, Problem
from gateway.config.tags.features.layout import default_type, layout_of, type_misfit
from gateway.config.tags.features.writing import check_bounds, needs_write, rule_of
from gateway.config.tags.registry import FEATURES
from gateway.config.tags.section import TagSource, inherit
from gateway.errors import ConfigError
from gateway.planning.planner import items_of
from gateway.protocols.driver import Address, Addressing, Cost, Span, Unit
from gateway.tags import Tag, WriteRule
from gateway.values import ValueType

_SIZES = {Unit.BIT: "bits", Unit.WORD: "words", Unit.DWORD: "values of 32 bits"}


def build_tag(source: TagSource, driver: Addressing) -> Tag | None:
    """Returns the tag, or None after its mistakes were noted."""
    before = len(source.mistakes)
    address = address_of(source, driver)
    if address is None:
        return None
    area = driver.areas.get(address.area)
    if area is None:  # a broadcast has no areas that are only readable
        problem = f"{source.own.address} is read-only, and station {driver.station} cannot be read"
        source.mistakes.add(problem, "address")
        return None
    if source.type_unknown:
        return None
    settings = inherit(source.inherited, source.own)
    kind = _type(source, settings, driver, address)
    units = 1 if address.bit is not None else kind.words // (2 if area.unit is Unit.DWORD else 1)
    span = Span(area.name, address.number, units)
    write = _write(source, settings, driver, span, kind)
    facts = Facts(
        kind=kind,
        text=source.own.address,
        settings=settings,
        spell=lambda: driver.spell(Address(area.name, span.start)),
        station=driver.station,
        area=area,
        bit=address.bit,
        write=write,
    )
    for place, problem in _misfits(driver, span, facts):
        source.mistakes.add(problem, place)
    check(source, facts)
    if len(source.mistakes) > before:
        return None
    return made(
        source,
        facts,
        address=address,
        span=span,
        unit_kind=area.unit,
        layout=layout_of(source.own, settings, driver, area, kind),
    )


def check(source: TagSource, facts: Facts) -> None:
    """Notes the settings of the tag that do not fit it."""
    checks = _features(frozenset(source.own.model_fields_set)).checks
    for check in (needs_write, *checks):
        for place, problem in check(source.own, facts):
            source.mistakes.add(problem, place)


class _Used(NamedTuple):
    """The functions of the features that some settings belong to."""

    checks: Sequence[Callable[[Any, Facts], Iterable[Problem]]]
    makes: Sequence[tuple[str, Callable[[Any, Facts], object | None]]]
    wraps: Sequence[Callable[[Any, Any, Tag], Tag]]


@lru_cache(maxsize=1024)
def _features(given: frozenset[str]) -> _Used:
    used = [one for one in FEATURES if not one.names.isdisjoint(given)]
    return _Used(
        [one.check for one in used if one.check is not None],
        [(one.slot, one.make) for one in used if one.make is not None],
        [one.wrap for one in used if one.wrap is not None],
    )


def kept_by(source: TagSource, facts: Facts) -> Mapping[str, Any]:
    """Returns the arguments of `Tag` that its features make."""
    found: dict[str, Any] = {}
    others = []
    for slot, make in _features(frozenset(facts.settings.model_fields_set)).makes:
        if (kept := make(source.own, facts)) is None:
            continue
        if slot:
            found[slot] = kept
        else:
            others.append(kept)
    found["features"] = tuple(others)
    return found


def made(source: TagSource, facts: Facts, **place: Any) -> Tag:
    """Returns the tag of checked settings. `place`: more arguments of `Tag`."""
    tag = Tag(
        device=source.device,
        name=source.name,
        text=source.own.address,
        every=facts.settings.every,
        write=facts.write,
        **place,
        **kept_by(source, facts),
    )
    for setting, problem in check_bounds(source.own, tag):
        source.mistakes.add(problem, "write", setting)
    for wrap in _features(frozenset(facts.settings.model_fields_set)).wraps:
        tag = wrap(source.own, facts.settings, tag)
    return tag


def address_of(source: TagSource, driver: Addressing) -> Address | None:
    """Returns the address of the tag, or None after the mistake was noted."""
    try:
        return driver.address(source.own.address)
    except ConfigError as error:
        source.mistakes.add(str(error), "address")
        return None


def _type(source: TagSource, settings: Any, driver: Addressing, address: Address) -> ValueType:
    area = driver.areas[address.area]
    default = default_type(driver, Unit.BIT if address.bit is not None else area.unit)
    wanted: ValueType | None = settings.type
    if wanted is None:
        return default
    misfit = type_misfit(wanted, area, address, driver)
    if misfit is None:
        return wanted
    if source.sets("type"):
        source.mistakes.add(misfit, "type")
    return default


def _misfits(driver: Addressing, span: Span, facts: Facts) -> Iterator[Problem]:
    """Yields what is wrong with the size of the tag."""
    area, kind = driver.areas[span.area], facts.kind
    cost = driver.cost(span) if area.readable else driver.write_cost(span)
    size = f"{span.size} {_SIZES[area.unit]}"
    if span.start + span.size - 1 > area.last:
        last = driver.spell(Address(area.name, area.last))
        yield "address", f"a {kind} at {facts.name} takes {size}, but the last is {last}"
    elif cost is None:
        most = most_that_fits(driver, span, kind, write=not area.readable) if kind.count else ""
        yield "type", f"a {kind} is {size}, more than one request can carry{most}"


def _write(
    source: TagSource, settings: Any, driver: Addressing, span: Span, kind: ValueType
) -> WriteRule | None:
    """Returns the rule for writing; None where the tag cannot be written."""
    setting = settings.write
    if setting is False:
        return None
    own, spelt = source.sets("write"), source.own.address
    area = driver.areas[span.area]
    if not area.writable:
        if own:
            source.mistakes.add(f"{spelt} is read-only: {area.name} cannot be written", "write")
        return None
    # A long array is written with several requests, each of whole elements.
    least = span._replace(size=span.size // kind.count) if kind.count else span
    if area.readable and driver.cost(span) is not None and driver.write_cost(least) is None:
        if own:
            source.mistakes.add(f"{spelt} cannot be written with one request", "write")
        return None
    return rule_of(setting, kind, polled=settings.poll)


_LONG = 4  # units; no single number has more


def most_that_fits(driver: Addressing, span: Span, kind: ValueType, *, write: bool) -> str:
    """Returns the longest array there that one request holds, for a message; empty: none."""
    size = span.size // kind.count
    cost_of = driver.write_cost if write else driver.cost
    for count in range(kind.count - 1, 0, -1):
        cost: Cost | None = cost_of(span._replace(size=count * size))
        if cost is not None:
            return f": at most {replace(kind, count=count)}"
    return ""


def check_overlaps(driver: Addressing, tags: Sequence[Tag], mistakes: Mistakes) -> None:
    """Notes tags that overlap and that no request can read together: each is read as a whole."""
    areas = {tag.span.area for tag in tags if tag.span.size > _LONG and tag.origin.shape is None}
    for area in areas:
        if not driver.areas[area].readable:
            continue
        for item in items_of(tag for tag in tags if tag.span.area == area):
            size = item.end - item.start
            if len(item.tags) > 1 and driver.cost(Span(area, item.start, size)) is None:
                last = max(item.tags, key=lambda tag: tag.span.start + tag.span.size)
                mistakes.at(last.name, "address").add(
                    f"{item.tags[0].text} to {last.text} overlap, and together they are {size} "
                    "addresses, more than one request can carry: make them shorter"
                )
