"""Builds the tags of devices. Tags that are written alike are built once and copied."""

from dataclasses import dataclass, field
from typing import Any

from gateway.config.messages import Mistakes, Path
from gateway.config.settings import parsers
from gateway.config.settings.validate import section
from gateway.config.tags.features.bits import with_bits
from gateway.config.tags.features.feature import Facts
from gateway.config.tags.features.writing import rule_of
from gateway.config.tags.section import ComputedSection, TagDefaults, TagSection, TagSource, inherit
from gateway.config.tags.word_tags import address_of, build_tag, check, made
from gateway.errors import ConfigError
from gateway.protocols.driver import Addressing, Span, Unit
from gateway.protocols.models import Model, model_of
from gateway.protocols.typed_fields import TypedField, TypedFields
from gateway.tags import Origin, Tag, WriteRule
from gateway.tags.tag import NotReal
from gateway.values import Layout

# By the text of the settings: numbers and booleans that are equal in Python are not alike.
_Alike = dict[str, Tag]


@dataclass(slots=True)
class DeviceTags:
    """Builds the tags of all devices of a file, and notes every mistake."""

    recorded: Path | None = None  # the first tag with `history: true`
    computed: list[TagSource] = field(default_factory=list)
    _names: dict[str, str] = field(default_factory=dict)  # correct ones, as typed
    _built: dict[tuple[Model, str], _Alike] = field(default_factory=dict)

    def build(
        self,
        device: str,
        raw_tags: object,
        mistakes: Mistakes,
        defaults: TagDefaults,
        driver: Addressing | None,
        *,
        not_real: NotReal | None = None,
    ) -> tuple[Tag, ...]:
        """Returns the tags of a device, without those that have mistakes."""
        alike: _Alike = {}
        if driver is not None:
            kind = model_of(driver), f"{defaults!r} {not_real}"
            alike = self._built.setdefault(kind, alike)
        tags: list[Tag] = []
        seen: set[str] = set()
        # Once for all tags: the search for its methods takes a tenth of the time of a tag.
        fields = driver if isinstance(driver, TypedFields) else None
        rows = with_bits(dict(mapping(raw_tags)), driver, mistakes)
        for raw_name, raw, place in rows:
            name = self._names.get(raw_name) or self._name(raw_name, mistakes.at(*place))
            if name in seen:
                mistakes.add(f"{name} is there twice, typed in two ways", *place)
            seen.add(name)
            if isinstance(raw, dict) and "computed" in raw:
                self._note_computed(device, name, raw, defaults, mistakes.at(*place))
                continue
            text = repr(raw)
            known = alike.get(text)
            if known is not None:
                tag: Tag | None = known.copy(device, name)
            else:
                before, own = len(mistakes), mistakes.at(*place)
                tag = _tag(device, name, raw, own, defaults, driver, fields)
                tag = None if tag is None else tag.with_origin(not_real)
                if tag is not None and len(mistakes) == before:
                    alike[text] = tag
            if tag is not None:
                if tag.publishing.history and self.recorded is None:
                    self.recorded = (*mistakes.path, *place)
                tags.append(tag)
        return tuple(tags)

    def _note_computed(
        self, device: str, name: str, raw: object, defaults: TagDefaults, mistakes: Mistakes
    ) -> None:
        own = section(ComputedSection, raw, mistakes, "a computed tag")
        if own is None:
            return
        self.computed.append(TagSource(device, name, own, defaults, mistakes))
        if inherit(defaults, own).history and self.recorded is None:
            self.recorded = mistakes.path

    def _name(self, text: str, mistakes: Mistakes) -> str:
        try:
            name = parsers.tag_name(text)
        except ConfigError as error:
            mistakes.add(str(error))
            return text
        self._names[text] = name
        return name


def _tag(
    device: str,
    name: str,
    raw: object,
    mistakes: Mistakes,
    defaults: TagDefaults,
    driver: Addressing | None,
    fields: TypedFields | None,
) -> Tag | None:
    own = section(TagSection, raw, mistakes, "a tag")
    if own is None or driver is None:
        return None
    unknown_type = isinstance(raw, dict) and "type" in raw and own.type is None
    source = TagSource(device, name, own, defaults, mistakes, type_unknown=unknown_type)
    if fields is not None:
        return field_tag(source, driver, fields)
    return build_tag(source, driver)


def mapping(raw: object) -> list[tuple[str, object]]:
    """Returns the entries of a mapping, and none of anything else."""
    return list(raw.items()) if isinstance(raw, dict) else []


def field_tag(source: TagSource, driver: Addressing, fields: TypedFields) -> Tag | None:
    """Returns the tag, or None after its mistakes were noted. `fields` is the driver as well."""
    before = len(source.mistakes)
    address = address_of(source, driver)
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
        write=_write(source, settings, name, field),
    )
    check(source, facts)
    if len(source.mistakes) > before:
        return None
    return made(
        source,
        facts,
        address=address,
        span=Span(address.area, address.number, 1),
        unit_kind=Unit.WORD,
        layout=Layout(field.type),
        origin=Origin(shape=field.shape),
    )


def _write(source: TagSource, settings: Any, name: str, field: TypedField) -> WriteRule | None:
    if settings.write is False:
        return None
    if field.writable:
        return rule_of(settings.write, field.type)
    if source.sets("write"):
        problem = f"{name} cannot be written: the device has no frame for it"
        hint = f", {field.write_hint}" if field.write_hint else ""
        source.mistakes.add(problem + hint, "write")
    return None
