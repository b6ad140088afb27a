"""Makes tags of the ranges in `transfers:`, such as mixer:D10..D19.

A range that is read becomes a polled tag of its device, `ranges/D10..D19`. A range that is written
becomes a tag that is not polled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from gateway.config.messages import Mistakes, meant
from gateway.config.settings.records import LineConfig
from gateway.config.tags.section import TagDefaults, TagSection, TagSource
from gateway.config.tags.word_tags import build_tag, check_overlaps
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.driver import Unit
from gateway.protocols.ranges import addresses
from gateway.protocols.typed_fields import TypedFields
from gateway.tags import Tag
from gateway.values import Kind

MOST = 64  # words or bits of a row, as in a table of LINK
READ, WRITTEN = "ranges/", "ranges/to/"  # begin the names of the tags
UNIT_KINDS = {Unit.BIT: Kind.BOOL, Unit.WORD: Kind.UINT16, Unit.DWORD: Kind.UINT32}


def is_range(text: str) -> bool:
    """True for `mixer:D10..D19`; a tag is `mixer/speed`."""
    device, colon, _ = text.partition(":")
    return bool(colon) and "/" not in device


@dataclass(slots=True)
class Ranges:
    """The tags of all ranges of one file."""

    lines: Sequence[LineConfig]
    every: Mapping[str, float]  # by device: the default interval of its tags
    mistakes: Mistakes
    read: dict[str, Tag] = field(default_factory=dict)  # by key
    written: dict[str, Tag] = field(default_factory=dict)

    def source(self, text: str, every: float | None, other: Tag | None, to: Mistakes) -> Tag | None:
        """Returns the tag that is polled; at the shortest interval of its rows.

        `other`: the tag at the other end, if that is no range.
        """
        tag = self._tag(text, READ, other, to, self._every(text) if every is None else every)
        if tag is None:
            return None
        known = self.read.get(tag.key)
        if known is None or known.every > tag.every:
            self.read[tag.key] = tag
        return self.read[tag.key]

    def target(self, text: str, other: Tag | None, to: Mistakes) -> Tag | None:
        """Returns the tag that is only written."""
        tag = self._tag(text, WRITTEN, other, to, self._every(text), write=True)
        return None if tag is None else self.written.setdefault(tag.key, tag)

    def _every(self, text: str) -> float:
        return self.every.get(text.partition(":")[0], TagDefaults().every)

    def _tag(
        self,
        text: str,
        begin: str,
        other: Tag | None,
        to: Mistakes,
        every: float,
        *,
        write: bool = False,
    ) -> Tag | None:
        name, _, spelt = text.partition(":")
        devices = {device.name: device for line in self.lines for device in line.devices}
        device = devices.get(name)
        if device is None:
            to.add(f"there is no device {name}: {meant(name, devices)}")
            return None
        found = Mistakes(to.places, path=to.path)
        try:
            own = {**_section(device, spelt, other), "write": write}
        except ConfigError as error:
            to.add(str(error))
            return None
        source = TagSource(
            name,
            f"{begin}{spelt.replace(':', '-')}",
            TagSection.model_validate(own),
            TagDefaults().model_copy(update={"every": every}),
            found,
        )
        tag = build_tag(source, device.driver)
        if tag is not None and tag.key in {one.key for one in device.tags}:
            found.add(f"{tag.key} is the name of this range: give that tag another name")
        for problem in found.sentences():
            to.add(problem)
        if tag is None or len(found):
            return None
        origins = (line.not_real for line in self.lines if device in line.devices)
        return tag.with_origin(next(origins, None))

    def added(self) -> list[LineConfig]:
        """Returns the lines with the tags of the ranges."""
        if not (self.read or self.written):
            return [*self.lines]
        return [
            replace(line, devices=tuple(self._with_ranges(line, device) for device in line.devices))
            for line in self.lines
        ]

    def _with_ranges(self, line: LineConfig, device: DeviceSettings) -> DeviceSettings:
        read = tuple(tag for tag in self.read.values() if tag.device == device.name)
        written = tuple(tag for tag in self.written.values() if tag.device == device.name)
        if not (read or written):
            return device
        found = Mistakes(self.mistakes.places)
        check_overlaps(device.driver, (*device.wire_tags, *read), found)
        for problem in found.sentences():
            self.mistakes.add(problem, "transfers")
        return replace(device, tags=(*device.tags, *read), targets=written)


def _section(device: DeviceSettings, spelt: str, other: Tag | None) -> dict[str, object]:
    """Returns the settings of the tag. Raises `ConfigError`."""
    if device.served is not None or isinstance(device.driver, TypedFields):
        what = "a station of the gateway" if device.served is not None else "no PLC with registers"
        raise ConfigError(f"{device.name} is {what}: name a tag, as device/tag")
    area, numbers = addresses(device.driver, spelt, MOST)
    kind = UNIT_KINDS[device.driver.areas[area].unit]
    if kind is Kind.UINT16 and other is not None and other.layout.type.kind is Kind.INT16:
        kind = Kind.INT16
    first, dots, _ = spelt.partition("..")
    return {"address": first.strip(), "type": f"{kind}[{len(numbers)}]" if dots else str(kind)}
