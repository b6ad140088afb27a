"""Makes computed tags: finds the inputs of their formulas, and loops."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gateway.config.messages import Mistakes, similar
from gateway.config.settings.records import LineConfig
from gateway.config.tags.features.feature import Facts
from gateway.config.tags.section import TagSource, inherit
from gateway.config.tags.word_tags import check, kept_by
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Origin, Tag
from gateway.tags.formula import Formula
from gateway.tags.tag import CounterRule
from gateway.values import Kind, Layout, ValueType

if TYPE_CHECKING:
    from gateway.config.tags.formulas import Parsed


@dataclass(slots=True)
class _Names:
    """Finds tags by the names in a formula."""

    tags: Mapping[str, Tag]  # by device/name
    sources: Mapping[str, TagSource]

    def key(self, source: TagSource, name: str) -> str:
        """Returns the key of an input: a tag of the same device, or `device/tag`."""
        for key in (f"{source.device}/{name}", name):
            if key in self.tags or key in self.sources:
                return key
        near = f"{source.device}/"
        known = [key.removeprefix(near) for key in (*self.tags, *self.sources)]
        close = similar(name, known)
        quotes = "'" if close and not close.replace("_", "a").isalnum() else ""
        hint = (
            f"did you mean {quotes}{close}{quotes}?"
            if close
            else "one of another device is written 'device/tag'"
        )
        raise ConfigError(f"{name} is no tag of {source.device}: {hint}")


def with_computed(lines: list[LineConfig], sources: list[TagSource]) -> list[LineConfig]:
    """Adds the computed tags to their devices."""
    if not sources:
        return lines
    known = {tag.key: tag for line in lines for device in line.devices for tag in device.tags}
    names = _Names(known, {source.key: source for source in sources})
    maker = _Maker(names, {})
    found = [tag for source in sources if (tag := maker.make(source, ())) is not None]
    return [
        replace(line, devices=tuple(_with_tags(device, found) for device in line.devices))
        for line in lines
    ]


def _with_tags(device: DeviceSettings, tags: list[Tag]) -> DeviceSettings:
    own = tuple(tag for tag in tags if tag.device == device.name)
    return replace(device, tags=(*device.tags, *own)) if own else device


@dataclass(slots=True)
class _Maker:
    names: _Names
    made: dict[str, Tag | None]

    def make(self, source: TagSource, below: tuple[str, ...]) -> Tag | None:
        """Returns the tag. `below`: the computed tags that need this one."""
        if source.key not in self.made:
            try:
                self.made[source.key] = self._make(source, below)
            except ConfigError as error:
                self.made[source.key] = None
                source.mistakes.add(str(error), "computed")
        return self.made[source.key]

    def _make(self, source: TagSource, below: tuple[str, ...]) -> Tag | None:
        # Its library takes 40 ms to load: a file without formulas does not need it.
        from gateway.config.tags.formulas import parse

        parsed = parse(source.own.computed)
        keys = [self.names.key(source, name) for name in parsed.names]
        way = (*below, source.key)
        for key in keys:
            if key in way:
                loop = " -> ".join((*way[way.index(key) :], key))
                raise ConfigError(f"a loop: {loop}: a value cannot follow from itself")
        inputs = [self._input(key, way) for key in keys]
        found = [one for one in inputs if one is not None]
        if not keys:
            raise ConfigError(f"{source.own.computed!r} names no tag: its value never changes")
        if len(found) < len(inputs):
            return None  # the mistake of the input is noted
        return self._tag(source, parsed, found)

    def _input(self, key: str, way: tuple[str, ...]) -> Tag | None:
        tag = self.names.tags.get(key) or self.make(self.names.sources[key], way)
        if tag is not None and tag.layout.type.is_text:
            raise ConfigError(f"{key} is a text: only numbers and bits can be calculated")
        if tag is not None and tag.layout.type.count:
            raise ConfigError(f"{key} is an array: only single numbers and bits can be calculated")
        return tag

    def _tag(self, source: TagSource, parsed: "Parsed", inputs: list[Tag]) -> Tag:
        settings = inherit(source.inherited, source.own)
        whole = parsed.whole and not any(one.value_type.startswith("float") for one in inputs)
        kind = ValueType(Kind.INT64 if whole else Kind.FLOAT64)
        facts = Facts(kind=kind, text="", settings=settings, whole=whole)
        check(source, facts)
        return Tag(
            device=source.device,
            name=source.name,
            text="",
            address=Address("", 0),
            span=Span("", 0, 0),
            unit_kind=Unit.WORD,
            layout=Layout(kind),
            every=min(one.every for one in inputs),
            origin=Origin(
                formula=Formula(source.own.computed, parsed.term, whole),
                inputs=tuple(inputs),
                not_real=next(filter(None, (one.origin.not_real for one in inputs)), None),
            ),
            **kept_by(source, facts),
        )


def check_totals(lines: Sequence[LineConfig], mistakes: Mistakes) -> None:
    """Notes totals in a standby group: each of its gateways would have another one."""
    for line in lines:
        for device in line.devices:
            for tag in device.tags:
                if isinstance(tag.origin.kept, CounterRule):
                    place = ("lines", line.name, "devices", device.name, "tags", tag.name)
                    mistakes.at(*place, "counter").add(
                        "a total is kept by one gateway, and this one has a standby: remove "
                        "counter, and count in the PLC"
                    )
