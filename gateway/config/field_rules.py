"""Makes the tags of devices with typed fields: the driver knows their type and access."""

from collections.abc import Iterator
from dataclasses import replace

from gateway.config.kept_rules import kept_tag
from gateway.config.messages import Mistakes
from gateway.config.model import TagDefaults, WriteSection
from gateway.config.tag_rules import (
    TagSource,
    address_of,
    assemble,
    check_bounds,
    inherit,
    only_for_numbers,
    write_rule,
)
from gateway.protocols.driver import Addressing, Span, Unit
from gateway.protocols.typed_fields import TypedField, TypedFields
from gateway.tags import Origin, Publish, Tag, WriteRule
from gateway.values import Layout

_OF_WORDS = ("type", "word_order", "byte_order", "byte", "bits")


def field_tag(
    source: TagSource, driver: Addressing, fields: TypedFields, mistakes: Mistakes
) -> Tag | None:
    """Returns the tag, or None after its mistakes were noted. `fields` is the driver as well."""
    before = len(mistakes)
    address = address_of(source, driver, mistakes)
    if address is None:
        return None
    settings = inherit(source.inherited, source.own)
    name, field = driver.spell(address), fields.typed_field(address)
    write = _write(source, settings, name, field, mistakes)
    for setting, problem in _misfits(source, name, field, write):
        mistakes.add((*source.path, setting), problem)
    if len(mistakes) > before:
        return None
    span = Span(address.area, address.number, 1)
    tag = assemble(source, settings, address, span, Unit.WORD, Layout(field.type), write, mistakes)
    rule = tag.publishing
    if source.own.event:
        rule = replace(rule, event=True, publish=Publish.ALWAYS, heartbeat=None)
    tag = replace(tag, origin=Origin(shape=field.shape), publishing=rule)
    check_bounds(source, tag, mistakes)
    return kept_tag(source.own, settings, tag, source.path, mistakes)


def _write(
    source: TagSource, settings: TagDefaults, name: str, field: TypedField, mistakes: Mistakes
) -> WriteRule | None:
    if settings.write is False:
        return None
    if field.writable:
        return write_rule(source, settings.write, field.type, mistakes)
    if source.sets("write"):
        problem = f"{name} cannot be written: the device has no frame for it"
        hint = f", {field.write_hint}" if field.write_hint else ""
        mistakes.add((*source.path, "write"), problem + hint)
    return None


def _misfits(
    source: TagSource, name: str, field: TypedField, write: WriteRule | None
) -> Iterator[tuple[str, str]]:
    """Yields settings with their mistake."""
    for setting in filter(source.sets, _OF_WORDS):
        yield setting, f"the field {name} has its own type: remove {setting} here"
    yield from only_for_numbers(source, field.type)
    if source.own.event and not field.unsolicited:
        hint = f": {field.event_hint}" if field.event_hint else ""
        yield "event", f"{name} never arrives unsolicited{hint}"
    if source.sets("every") and not field.polled:
        yield "every", f"{name} is never polled: it has no interval"
    if not field.polled and not field.unsolicited and write is None:
        yield "write", f"{name} can only be written: it needs write: true"
    if not field.polled and not field.unsolicited and source.own.alarm is not None:
        yield "alarm", f"{name} can only be written: it can have no alarm"
    rule = source.own.write
    if isinstance(rule, WriteSection) and rule.verify and not field.polled:
        yield "write", f"{name} cannot be read back, no request reads it: remove verify"
