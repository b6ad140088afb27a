"""Makes the tags of devices with typed fields: the driver knows their type and access."""

from typing import Any

from gateway.config.messages import Mistakes
from gateway.config.tags.features.feature import Facts
from gateway.config.tags.features.writing import rule_of
from gateway.config.tags.section import TagSource, inherit
from gateway.config.tags.word_tags import address_of, check, made
from gateway.protocols.driver import Addressing, Span, Unit
from gateway.protocols.typed_fields import TypedField, TypedFields
from gateway.tags import Origin, Tag, WriteRule
from gateway.values import Layout


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
    facts = Facts(
        kind=field.type,
        text=source.own.address,
        settings=settings,
        spell=lambda: name,
        station=driver.station,
        field=field,
        write=_write(source, settings, name, field, mistakes),
    )
    check(source, facts, mistakes)
    if len(mistakes) > before:
        return None
    return made(
        source,
        facts,
        mistakes,
        address=address,
        span=Span(address.area, address.number, 1),
        unit_kind=Unit.WORD,
        layout=Layout(field.type),
        origin=Origin(shape=field.shape),
    )


def _write(
    source: TagSource, settings: Any, name: str, field: TypedField, mistakes: Mistakes
) -> WriteRule | None:
    if settings.write is False:
        return None
    if field.writable:
        return rule_of(settings.write, field.type)
    if source.sets("write"):
        problem = f"{name} cannot be written: the device has no frame for it"
        hint = f", {field.write_hint}" if field.write_hint else ""
        mistakes.add((*source.path, "write"), problem + hint)
    return None
