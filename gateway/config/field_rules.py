"""From what the file says of a tag to the tag, for devices without a protocol: its field says
the most of it."""

from collections.abc import Iterator
from dataclasses import replace

from gateway.config.messages import Mistakes
from gateway.config.model import TagDefaults, WriteSection
from gateway.config.tag_rules import (
    TagSource,
    address_of,
    assemble,
    check_bounds,
    inherit,
    write_rule,
)
from gateway.protocols.driver import Address, Span, Unit
from gateway.protocols.frames import Field, FrameDriver
from gateway.tags import Publish, Tag, WriteRule
from gateway.values import LONGEST_STRING, Kind, Layout, ValueType

# What is not among the types of words is told as the next wider of them.
_KINDS = {
    "uint8": Kind.UINT16,
    "int8": Kind.INT16,
    "bcd8": Kind.BCD16,
    "integer": Kind.INT64,
    "decimal": Kind.FLOAT64,
}
_OF_WORDS = ("type", "word_order", "byte_order")


def field_tag(source: TagSource, driver: FrameDriver, mistakes: Mistakes) -> Tag | None:
    """The tag, or None after its mistakes were noted."""
    before = len(mistakes)
    address = address_of(source, driver, mistakes)
    if address is None:
        return None
    settings = inherit(source.inherited, source.own)
    kind = _kind(driver.settings.field_of(source.own.address))
    write = _write(source, settings, driver, address, kind, mistakes)
    for place, problem in _misfits(source, driver, address, kind, write):
        mistakes.add((*source.path, place), problem)
    if len(mistakes) > before:
        return None
    span = Span(address.area, address.number, 1)
    tag = assemble(source, settings, address, span, Unit.WORD, Layout(kind), write)
    tag = replace(tag, shape=driver.shape(address), event=source.own.event)
    if tag.event:
        tag = replace(tag, publish=Publish.ALWAYS, heartbeat=None)
    check_bounds(source, tag, mistakes)
    return tag


def _kind(field: Field) -> ValueType:
    if field.bit is not None:
        return ValueType(Kind.BOOL)
    if field.type == "text":
        first, _, last = (field.columns or "").partition("-")
        width = int(last) - int(first) + 1 if last else LONGEST_STRING
        return ValueType(Kind.STRING, width)
    return ValueType(_KINDS.get(field.type) or Kind(field.type))


def _write(
    source: TagSource,
    settings: TagDefaults,
    driver: FrameDriver,
    address: Address,
    kind: ValueType,
    mistakes: Mistakes,
) -> WriteRule | None:
    if settings.write is False:
        return None
    if driver.writable(address):
        return write_rule(source, settings.write, kind, mistakes)
    if source.says("write"):
        name = driver.spell(address)
        mistakes.add(
            (*source.path, "write"),
            f"{name} cannot be written: the device has no frame for it, `write: {{{name}: ...}}`",
        )
    return None


def _misfits(
    source: TagSource,
    driver: FrameDriver,
    address: Address,
    kind: ValueType,
    write: WriteRule | None,
) -> Iterator[tuple[str, str]]:
    """(setting, what is wrong with it)."""
    name = driver.spell(address)
    asked, listened = name in driver.settings.asked, name in driver.settings.listened
    for setting in filter(source.says, _OF_WORDS):
        yield setting, f"what {name} is, its field says: no {setting} here"
    if not kind.is_number:
        for setting in filter(source.says, ("scale", "offset", "deadband")):
            yield setting, f"a {kind} has no {setting}: only numbers have"
    if source.own.event and not listened:
        yield "event", f"{name} never comes unasked: events are fields under `listen`"
    if source.says("every") and not asked:
        yield "every", f"{name} is never asked for: it has no interval"
    if not asked and not listened and write is None:
        yield "write", f"{name} is only written: it needs write: true"
    rule = source.own.write
    if isinstance(rule, WriteSection) and rule.verify and not asked:
        yield "write", f"{name} cannot be read back, no question asks for it: no verify"
