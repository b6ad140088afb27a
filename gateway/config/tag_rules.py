"""Makes tags: checks that the device has the address and that all settings fit."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

from gateway.config.alarm_rules import alarm_misfits, alarm_rule
from gateway.config.array_rules import array_misfits, most_that_fits
from gateway.config.kept_rules import kept_tag
from gateway.config.messages import Mistakes, Path
from gateway.config.model import (
    AlarmSection,
    ComputedSection,
    TagDefaults,
    TagSection,
    WriteSection,
)
from gateway.config.shaping_rules import shaping_of
from gateway.errors import BadValue, ConfigError
from gateway.protocols.driver import Address, Addressing, Area, Span, Unit
from gateway.tags import Label, Publishing, Tag, WriteRule
from gateway.values import BYTES, Byte, Kind, Layout, Order, ValueType

_SIZES = {Unit.BIT: "bits", Unit.WORD: "words", Unit.DWORD: "values of 32 bits"}
_WIDE = (Kind.INT32, Kind.UINT32, Kind.FLOAT32, Kind.BCD32)


@dataclass(frozen=True, slots=True)
class TagSource:
    """One tag in the file: its own settings, and those that it inherits.

    An inherited setting that does not fit the tag is ignored (a scale for a bit, `write` for an
    input); a setting of its own must fit.
    """

    device: str
    name: str
    own: TagSection
    inherited: TagDefaults
    path: Path
    type_unknown: bool = False  # its `type` was a mistake: the fit cannot be checked

    def sets(self, setting: str) -> bool:
        return setting in self.own.model_fields_set


def inherit(outer: TagDefaults, inner: TagDefaults | ComputedSection) -> TagDefaults:
    """Returns the settings of `outer`, replaced by those that `inner` sets itself."""
    if not inner.model_fields_set:
        return outer
    replaced = {name: getattr(inner, name) for name in inner.model_fields_set}
    if (
        isinstance(inner, TagDefaults) and inner.from_ is not None
    ):  # one of the two ways to scale replaces the other
        replaced |= {"scale": 1.0, "offset": 0.0}
    elif inner.model_fields_set & {"scale", "offset"}:
        replaced |= {"from_": None, "to": None}
    return outer.model_copy(update=replaced)


def build_tag(source: TagSource, driver: Addressing, mistakes: Mistakes) -> Tag | None:
    """Returns the tag, or None after its mistakes were noted."""
    before = len(mistakes)
    address = address_of(source, driver, mistakes)
    if address is None:
        return None
    area = driver.areas.get(address.area)
    if area is None:  # a broadcast has no areas that are only readable
        problem = f"{source.own.address} is read-only, and station {driver.station} cannot be read"
        mistakes.add((*source.path, "address"), problem)
        return None
    if source.type_unknown:
        return None
    settings = inherit(source.inherited, source.own)
    kind = _type(source, settings, driver, address, mistakes)
    units = 1 if address.bit is not None else kind.words // (2 if area.unit is Unit.DWORD else 1)
    span = Span(area.name, address.number, units)
    write = _write(source, settings, driver, span, kind, mistakes)
    for place, problem in _misfits(source, driver, address, span, kind, write):
        mistakes.add((*source.path, place), problem)
    if len(mistakes) > before:
        return None
    layout = _layout(source, settings, driver, area, kind)
    tag = assemble(source, settings, address, span, area.unit, layout, write, mistakes)
    check_bounds(source, tag, mistakes)
    return kept_tag(source.own, settings, tag, source.path, mistakes)


def address_of(source: TagSource, driver: Addressing, mistakes: Mistakes) -> Address | None:
    """Returns the address of the tag, or None after the mistake was noted."""
    try:
        return driver.address(source.own.address)
    except ConfigError as error:
        mistakes.add((*source.path, "address"), str(error))
        return None


def assemble(
    source: TagSource,
    settings: TagDefaults,
    address: Address,
    span: Span,
    unit_kind: Unit,
    layout: Layout,
    write: WriteRule | None,
    mistakes: Mistakes,
) -> Tag:
    """Returns the tag, without settings of numbers where its type is no number."""
    wrong: list[tuple[str, str]] = []
    shaping = shaping_of(source.own, settings, layout.type, wrong)
    for setting, problem in wrong:
        mistakes.add((*source.path, setting.rstrip("_")), problem)
    return Tag(
        device=source.device,
        name=source.name,
        text=source.own.address,
        address=address,
        span=span,
        unit_kind=unit_kind,
        layout=layout,
        every=settings.every,
        shaping=shaping,
        publishing=_publishing(
            settings.deadband if layout.type.is_number and shaping.names is None else None,
            settings.publish,
            settings.heartbeat,
            settings.payload,
            settings.history,
        ),
        write=write,
        features=features_of(settings, source.own.alarm),
    )


_publishing = lru_cache(maxsize=4096)(Publishing)  # one object for all that are equal


def features_of(settings: TagDefaults, alarm: AlarmSection | None) -> tuple[object, ...]:
    """Returns the features that no read needs."""
    found: list[object] = []
    if settings.unit or settings.description:
        found.append(Label(settings.unit, settings.description))
    if (rule := alarm_rule(alarm, settings.description)) is not None:
        found.append(rule)
    return tuple(found)


def _type(
    source: TagSource,
    settings: TagDefaults,
    driver: Addressing,
    address: Address,
    mistakes: Mistakes,
) -> ValueType:
    area = driver.areas[address.area]
    default = _default_type(driver, Unit.BIT if address.bit is not None else area.unit)
    if settings.type is None:
        return default
    misfit = _type_misfit(settings.type, area, address, driver)
    if misfit is None:
        return settings.type
    if source.sets("type"):
        mistakes.add((*source.path, "type"), misfit)
    return default


def _default_type(driver: Addressing, unit: Unit) -> ValueType:
    match unit:
        case Unit.BIT:
            return ValueType(Kind.BOOL)
        case Unit.WORD:
            return ValueType(driver.traits.word_type)
        case Unit.DWORD:
            return ValueType(Kind.INT32)


def _layout(
    source: TagSource, settings: TagDefaults, driver: Addressing, area: Area, kind: ValueType
) -> Layout:
    if area.unit is Unit.DWORD:  # the driver puts it together, whatever its order on the wire
        return Layout(kind)
    if kind.kind in BYTES:
        return Layout(kind, byte=source.own.byte or Byte.LOW)
    usual = driver.traits.string_order if kind.kind is Kind.STRING else Order.HIGH_FIRST
    return Layout(kind, settings.word_order, settings.byte_order or usual)


def _type_misfit(kind: ValueType, area: Area, address: Address, driver: Addressing) -> str | None:
    spelt = driver.spell(address)
    if area.unit is Unit.BIT or address.bit is not None:
        what = "is a bit" if address.bit is None else "is one bit of a word"
        fits = kind.kind is Kind.BOOL and not (kind.count and address.bit is not None)
        return None if fits else f"{spelt} {what}: it can only be bool"
    if area.unit is Unit.DWORD:
        wide = ", ".join(_WIDE)
        return None if kind.kind in _WIDE else f"{spelt} has 32 bits, no {kind}: use one of {wide}"
    if kind.kind is Kind.BOOL and kind.count:
        return f"{spelt} is a word: a {kind} is an array of bits; for words write uint16[n]"
    if kind.kind is Kind.BOOL:
        bit = driver.spell(address._replace(bit=0))
        return f"{spelt} is a word: for one of its bits write {bit}, or name a type for the word"
    return None


def _misfits(
    source: TagSource,
    driver: Addressing,
    address: Address,
    span: Span,
    kind: ValueType,
    write: WriteRule | None,
) -> Iterator[tuple[str, str]]:
    """Yields settings with their mistake."""
    area = driver.areas[span.area]
    first = driver.spell(Address(area.name, span.start))
    cost = driver.cost(span) if area.readable else driver.write_cost(span)
    size = f"{span.size} {_SIZES[area.unit]}"
    if span.start + span.size - 1 > area.last:
        last = driver.spell(Address(area.name, area.last))
        yield "address", f"a {kind} at {first} takes {size}, but the last is {last}"
    elif cost is None:
        most = most_that_fits(driver, span, kind, write=not area.readable) if kind.count else ""
        yield "type", f"a {kind} is {size}, more than one request can carry{most}"
    if not area.readable and write is None:
        yield "write", f"{first} is never read at station {driver.station}: it needs write: true"
    if not area.readable and (address.bit is not None or kind.kind in BYTES):
        yield "address", f"{first} is never read at station {driver.station}: write the whole word"
    if not area.readable and source.own.alarm is not None:
        yield "alarm", f"{first} is never read at station {driver.station}: it can have no alarm"
    if not area.readable and write is not None and write.verify:
        yield "write", f"{first} is never read at station {driver.station}: verify cannot work"
    yield from _unsuited(source, area, first, kind)


def _unsuited(
    source: TagSource, area: Area, first: str, kind: ValueType
) -> Iterator[tuple[str, str]]:
    """Yields settings that this tag cannot have."""
    spelt = source.own.address
    if source.own.event:
        yield "event", f"{first} is polled: only an unsolicited value can be an event"
    if area.unit is Unit.DWORD:
        for setting in filter(source.sets, ("word_order", "byte_order")):
            yield setting, f"{first} has 32 bits by nature: it needs no {setting}"
    elif source.sets("word_order") and not (kind.is_number and kind.element.words > 1):
        yield "word_order", f"{spelt} is {kind}: only numbers of 32 or 64 bits have a word_order"
    if kind.kind in BYTES and source.sets("byte_order"):
        yield "byte_order", f"{spelt} is one byte: write byte: low or byte: high"
    elif kind.kind is Kind.BOOL and source.sets("byte_order"):
        yield "byte_order", f"{spelt} is {kind}: only words have a byte_order"
    yield from only_for_numbers(source, kind)


def only_for_numbers(source: TagSource, kind: ValueType) -> Iterator[tuple[str, str]]:
    """Yields settings of numbers at a text or a bit."""
    if not kind.is_number:
        for setting in filter(source.sets, ("scale", "offset", "deadband")):
            yield setting, f"a {kind} has no {setting}: only numbers have"
    if kind.count:
        yield from array_misfits(source.own, kind)
    elif source.own.alarm is not None:
        yield from alarm_misfits(source.own.alarm, kind)


def _write(
    source: TagSource,
    settings: TagDefaults,
    driver: Addressing,
    span: Span,
    kind: ValueType,
    mistakes: Mistakes,
) -> WriteRule | None:
    """Returns the rule for writing; None where the tag cannot be written."""
    setting, path = settings.write, (*source.path, "write")
    if setting is False:
        return None
    own, spelt = source.sets("write"), source.own.address
    area = driver.areas[span.area]
    if not area.writable:
        if own:
            mistakes.add(path, f"{spelt} is read-only: {area.name} cannot be written")
        return None
    # A long array is written with several requests, each of whole elements.
    least = span._replace(size=span.size // kind.count) if kind.count else span
    if area.readable and driver.cost(span) is not None and driver.write_cost(least) is None:
        if own:
            mistakes.add(path, f"{spelt} cannot be written with one request")
        return None
    return write_rule(source, setting, kind, mistakes)


def write_rule(
    source: TagSource, setting: bool | WriteSection, kind: ValueType, mistakes: Mistakes
) -> WriteRule:
    """Returns the rule of `write:` for a tag that can be written."""
    if not isinstance(setting, WriteSection):
        return WriteRule()
    bounded = setting.min is not None or setting.max is not None
    if bounded and not kind.is_number and source.sets("write"):
        mistakes.add((*source.path, "write"), f"a {kind} has no min and max: only numbers have")
    number = kind.is_number
    return WriteRule(
        min=setting.min if number else None,
        max=setting.max if number else None,
        verify=setting.verify,
        repeat=setting.repeat,
        latest=setting.latest,
    )


def check_bounds(source: TagSource, tag: Tag, mistakes: Mistakes) -> None:
    """Notes a bound that the device cannot hold: the first write with it would be refused."""
    if tag.write is None or not source.sets("write"):
        return
    for setting in ("min", "max"):
        bound = getattr(tag.write, setting)
        if bound is None:
            continue
        try:
            (tag.element or tag).encode(int(bound) if bound == int(bound) else bound)
        except BadValue as error:
            mistakes.add((*source.path, "write", setting), str(error))
