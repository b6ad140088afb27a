"""Builds the stations of served lines: the role of each tag, and the addresses to write."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

from gateway.config.messages import Mistakes, Path, one_of, shown
from gateway.config.settings import parsers
from gateway.config.settings.model import DeviceSection, LineSection
from gateway.config.settings.records import LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.errors import ConfigError
from gateway.protocols.driver import Address, AnyDriver, Area, Cost, Span, Timing, Traits
from gateway.stations.served.registers import STALE_AFTER, Served, ServedTag, cells_of
from gateway.stations.served.registry import can_serve, common_settings, served_protocols
from gateway.tags import Publish, Tag
from gateway.transport.port import SimulatorAddress
from gateway.values import Kind

_TELEPHONE = 2.0  # seconds: modems repeat what the line has damaged
_OF_DEVICES = ("accept", "stale_after")
_OF_TAGS = ("source", "retain", "hold_last")
_OF_MASTERS = (
    "reply_timeout",
    "retries",
    "verify_reads",
    "late_guard",
    "silence",
    "control",
    "identity",
)


@dataclass(frozen=True, slots=True)
class ServedView:
    """The addresses of a driver as a station has them: the gateway gives every one a value."""

    driver: AnyDriver

    @property
    def protocol(self) -> str:
        return self.driver.protocol

    @property
    def station(self) -> int:
        return self.driver.station

    @property
    def traits(self) -> Traits:
        return self.driver.traits

    @property
    def timing(self) -> Timing:
        return self.driver.timing

    @property
    def areas(self) -> Mapping[str, Area]:
        return {
            name: replace(area, readable=True, writable=True)
            for name, area in self.driver.areas.items()
        }

    def address(self, text: str) -> Address:
        return self.driver.address(text)

    def spell(self, address: Address) -> str:
        return self.driver.spell(address)

    def cost(self, span: Span) -> Cost | None:
        return self.driver.cost(span)

    def write_cost(self, span: Span) -> Cost | None:
        return self.driver.cost(span)


@dataclass(frozen=True, slots=True)
class ServedDevice:
    """One station in the file. `sheets`: the settings of its tags in sheets."""

    driver: AnyDriver
    settings: DeviceSection
    raw: Mapping[str, Any]
    sheets: Sequence[Mapping[str, Mapping[str, object]]]
    defaults: Any
    mistakes: Mistakes

    def build(self, tags: Sequence[Tag]) -> tuple[Served, tuple[Tag, ...]]:
        """Returns the station, and its tags that have keys of their own: those without source."""
        for setting in _OF_MASTERS:
            if setting in self.settings.model_fields_set:
                self.mistakes.at(setting).add(
                    f"{setting} has no effect: a served device sends no request"
                )
        accept = tuple(filter(None, map(self._accepted, range(len(self.settings.accept)))))
        stale_after = self.settings.stale_after
        served = Served(
            rows=(), accept=accept, stale_after=STALE_AFTER if stale_after is None else stale_after
        )
        rows = tuple(self._row(tag, served) for tag in tags)
        self._check_overlaps(rows)
        return replace(served, rows=rows), tuple(row.tag for row in rows if row.source is None)

    def _accepted(self, number: int) -> Span | None:
        """Returns the addresses of one entry of `accept`; None for a mistake."""
        text = self.settings.accept[number]
        own = self.mistakes.at("accept", number)
        first, dots, last = (part.strip() for part in text.partition(".."))
        try:
            begin = self.driver.address(first)
            end = self.driver.address(last) if dots else begin
        except ConfigError as error:
            own.add(str(error))
            return None
        area = self.driver.areas.get(begin.area)
        if begin.area != end.area or begin.number > end.number or area is None:
            own.add(f"{text} is no range: write it as D100..D119, the lower one first")
        elif begin.bit is not None or end.bit is not None:
            own.add(f"{text}: a master writes whole words: leave out the bit")
        elif not area.writable:
            own.add(f"{text}: a master cannot write {first}, it is read-only")
        else:
            return Span(begin.area, begin.number, end.number - begin.number + 1)
        return None

    def _row(self, tag: Tag, served: Served) -> ServedTag:
        own = self._own(tag.name)
        mistakes = self.mistakes.at("tags", tag.name)
        source, retain = own.get("source"), own.get("retain") is True
        tag = self._without_reads(tag, own)
        hold_last = own.get("hold_last", self.defaults.hold_last) is True
        inside = [served.takes(*cell) for cell in cells_of(tag.span)]
        accepted = any(inside)
        if accepted and not all(inside):
            mistakes.add(f"{tag.text} is in `accept` only in part: it has {len(inside)} words")
        for problem in _role_problems(
            own, source, accepted=accepted, written=tag.write is not None
        ):
            mistakes.add(problem)
        if retain and (accepted or source is not None):
            mistakes.add("retain keeps what clients write: it needs `write: true`", "retain")
        if "every" in own:
            mistakes.add("every has no effect: the master decides when it asks", "every")
        if accepted and own.get("publish") != "change" and tag.publishing.deadband is None:
            each = replace(tag.publishing, publish=Publish.ALWAYS, event=True, heartbeat=None)
            tag = replace(tag, publishing=each)
        if accepted or source is not None:
            tag = replace(tag, write=None)
        else:
            tag = replace(tag, origin=replace(tag.origin, held=True))
        return ServedTag(
            tag=tag,
            source=source if isinstance(source, str) else None,
            hold_last=hold_last,
            retain=retain,
            accepted=accepted,
        )

    def _without_reads(self, tag: Tag, own: Mapping[str, object]) -> Tag:
        """Returns the tag without the settings of values that the gateway reads. Notes them."""
        for setting in ("debounce", "counter", "range"):
            if own.get(setting):
                text = f"{setting} is for values that the gateway reads: remove it here"
                self.mistakes.add(text, "tags", tag.name, setting)
        if tag.origin.kept is not None:
            tag = replace(tag, origin=tag.origin.inputs[0].origin)
        if tag.shaping.range is not None:
            tag = replace(tag, shaping=replace(tag.shaping, range=None))
        return tag

    def _own(self, name: str) -> Mapping[str, object]:
        """Returns the settings of a tag in the file or in a sheet."""
        for tags in (self.raw.get("tags"), *self.sheets):
            for spelt, own in tags.items() if isinstance(tags, Mapping) else ():
                if isinstance(own, Mapping) and _name(spelt) == name:
                    return own
        return {}

    def _check_overlaps(self, rows: Sequence[ServedTag]) -> None:
        """Two tags may show one word only as different parts of it, or where a master writes."""
        known: dict[tuple[str, int], list[ServedTag]] = {}
        for row in rows:
            for cell in cells_of(row.tag.span):
                others = known.setdefault(cell, [])
                for other in others:
                    if not row.accepted and _bits(row.tag) & _bits(other.tag):
                        text = f"{other.tag.name} of this device is at {row.tag.text} already"
                        self.mistakes.add(text, "tags", row.tag.name, "address")
                others.append(row)


def _bits(tag: Tag) -> int:
    """Returns the bits of each word that a tag has."""
    return 0xFFFF_FFFF if tag.part is None else tag.part.bits


def _role_problems(
    own: Mapping[str, object], source: object, *, accepted: bool, written: bool
) -> Iterator[str]:
    """Yields a sentence unless exactly one part gives the tag its value."""
    if accepted and source is not None:
        yield "the master writes it (`accept`), so it has no `source`"
    elif (accepted or source is not None) and own.get("write"):
        by = "the master writes it (`accept`)" if accepted else "it has a `source`"
        yield f"{by}, so clients cannot write it: leave out `write`"
    elif not (accepted or source is not None or written):
        yield (
            "nothing gives it a value: write `source: device/tag` (the value of another tag), "
            "`write: true` (clients write it), or put its address into `accept` (the master does)"
        )


def _name(text: object) -> str:
    try:
        return parsers.tag_name(text)
    except ConfigError:
        return str(text)


def only_served(raw: Mapping[str, Any], mistakes: Mistakes) -> None:
    """Notes settings of served lines at a device of another line."""
    tags = raw.get("tags")
    rest = tags.items() if isinstance(tags, Mapping) else ()
    places: list[Path] = [(setting,) for setting in _OF_DEVICES if setting in raw]
    for name, own in rest:
        if isinstance(own, Mapping):
            places += [("tags", name, setting) for setting in _OF_TAGS if setting in own]
    for place in places:
        text = f"{place[-1]} is a setting of served lines: this line has no `serve: true`"
        mistakes.add(text, *place)


def until_the_next_call(device: DeviceSettings, line: Mapping[str, Any]) -> DeviceSettings:
    """Returns a station behind a modem: without `stale_after` the values stay between calls."""
    own = line.get("devices", {}).get(device.name)
    if device.served is None or (isinstance(own, Mapping) and "stale_after" in own):
        return device
    return replace(device, served=replace(device.served, stale_after=math.inf))


def request_gap(line: LineSection, *, dials: bool) -> float | None:
    """Returns the longest pause within a request of a master; None: by the speed of the line."""
    return _TELEPHONE if line.request_gap is None and dials else line.request_gap


def check_served_line(
    line: LineSection, devices: Sequence[DeviceSettings], mistakes: Mistakes
) -> None:
    """Notes what cannot be served together."""
    if isinstance(line.port, SimulatorAddress):
        mistakes.add("a served line needs a real port: its master is elsewhere", "port")
    first = devices[0] if devices else None
    for device in devices:
        driver, own = device.driver, mistakes.at("devices", device.name)
        if not can_serve(driver.protocol):
            known = one_of(served_protocols())
            own.add(f"{driver.protocol} cannot be served: {known} can", "protocol")
        if driver.station == 0 and all(not area.readable for area in driver.areas.values()):
            own.add("station 0 is all stations: it never answers", "station")
        if first is None or driver.protocol != first.driver.protocol:
            own.at("protocol").add(
                "all stations of a served line speak one protocol: give this device its own line"
            )
            continue
        for setting in common_settings(driver.protocol):
            if getattr(driver, setting) != getattr(first.driver, setting):
                text = f"{first.name} on this line has {shown(getattr(first.driver, setting))}"
                own.add(f"{text}: all stations of a line have the same", setting)


def check_sources(lines: Sequence[LineConfig], mistakes: Mistakes) -> None:
    """Notes sources that do not exist, or do not fit."""
    rows = [(path, row) for path, row in _rows(lines) if row.source is not None]
    if not rows:  # as in most files
        return
    tags = {tag.key: tag for line in lines for device in line.devices for tag in device.tags}
    for path, row in rows:
        source, own = tags.get(row.source or ""), mistakes.at(*path, "source")
        if source is None:
            text = f"there is no tag {row.source}: write device/tag, a tag of this file"
            own.add(text)
        elif source.layout.type.count != row.tag.layout.type.count:
            kinds = f"{row.source} is {source.layout.type}, and this is {row.tag.layout.type}"
            own.add(f"{kinds}: an array is shown as an array of the same length")
        elif sort_of(source) != sort_of(row.tag):
            kinds = f"{row.source} is {source.layout.type}, and this is {row.tag.layout.type}"
            own.add(f"{kinds}: a value is shown as bit, number or text, not as another")


def sort_of(tag: Tag) -> str:
    """Returns `number`, `bit` or `text`: a value of one is never carried to another."""
    kind = tag.layout.type
    return "number" if kind.is_number else "bit" if kind.kind is Kind.BOOL else "text"


def check_retained(
    lines: Sequence[LineConfig], state_file: FilePath | None, standby: str | None, to: Mistakes
) -> None:
    """Notes tags with `retain` in a gateway that cannot keep their values."""
    if state_file is None:
        why = "the gateway has no file for it: write `gateway: {state: state.json}`"
    elif standby is not None:
        why = "a standby would answer with the values of its own file, which are old"
    else:
        return
    for path, row in _rows(lines):
        if row.retain:
            to.add(why, *path, "retain")


def _rows(lines: Sequence[LineConfig]) -> Iterator[tuple[Path, ServedTag]]:
    for line in lines:
        for device in line.devices:
            path = ("lines", line.name, "devices", device.name, "tags")
            for row in device.served.rows if device.served is not None else ():
                yield (*path, row.tag.name), row
