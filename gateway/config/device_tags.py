"""Builds the tags of devices. Tags that are written alike are built once and copied."""

from dataclasses import dataclass, field

from gateway.config import parsers
from gateway.config.field_rules import field_tag
from gateway.config.messages import Mistakes, Path
from gateway.config.model import TagDefaults, TagSection
from gateway.config.tag_rules import TagSource, build_tag
from gateway.config.validate import section
from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver
from gateway.protocols.models import Model, model_of
from gateway.protocols.typed_fields import TypedFields
from gateway.tags import Tag

# By the text of the settings: numbers and booleans that are equal in Python are not alike.
_Alike = dict[str, Tag]


@dataclass(slots=True)
class DeviceTags:
    """Builds the tags of all devices of a file, and notes every mistake."""

    mistakes: Mistakes
    recorded: Path | None = None  # the first tag with `history: true`
    _names: dict[str, str] = field(default_factory=dict)  # correct ones, as typed
    _built: dict[tuple[Model, str], _Alike] = field(default_factory=dict)

    def build(
        self,
        device: str,
        raw_tags: object,
        path: Path,
        defaults: TagDefaults,
        driver: AnyDriver | None,
    ) -> tuple[Tag, ...]:
        """Returns the tags of a device, without those that have mistakes."""
        alike: _Alike = {}
        if driver is not None:
            alike = self._built.setdefault((model_of(driver), repr(defaults)), alike)
        tags: list[Tag] = []
        seen: set[str] = set()
        for raw_name, raw in mapping(raw_tags):
            name = self._names.get(raw_name) or self._name(raw_name, (*path, raw_name))
            if name in seen:
                self.mistakes.add((*path, raw_name), f"{name} is there twice, typed in two ways")
            seen.add(name)
            text = repr(raw)
            known = alike.get(text)
            if known is not None:
                tag: Tag | None = known.copy(device, name)
            else:
                before = len(self.mistakes)
                tag = self._tag(device, name, raw, (*path, raw_name), defaults, driver)
                if tag is not None and len(self.mistakes) == before:
                    alike[text] = tag
            if tag is not None:
                if tag.history and self.recorded is None:
                    self.recorded = (*path, raw_name)
                tags.append(tag)
        return tuple(tags)

    def _tag(
        self,
        device: str,
        name: str,
        raw: object,
        place: Path,
        defaults: TagDefaults,
        driver: AnyDriver | None,
    ) -> Tag | None:
        own = section(TagSection, raw, place, self.mistakes, "a tag")
        if own is None or driver is None:
            return None
        unknown_type = isinstance(raw, dict) and "type" in raw and own.type is None
        source = TagSource(device, name, own, defaults, place, type_unknown=unknown_type)
        if isinstance(driver, TypedFields):
            return field_tag(source, driver, driver, self.mistakes)
        return build_tag(source, driver, self.mistakes)

    def _name(self, text: str, path: Path) -> str:
        try:
            name = parsers.tag_name(text)
        except ConfigError as error:
            self.mistakes.add(path, str(error))
            return text
        self._names[text] = name
        return name


def mapping(raw: object) -> list[tuple[str, object]]:
    """Returns the entries of a mapping, and none of anything else."""
    return list(raw.items()) if isinstance(raw, dict) else []
