"""The differences between two configurations: devices that changed, and values that go on."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from pydantic import BaseModel

from gateway.config.settings.records import Config, LineConfig
from gateway.engine.device.device_settings import DeviceSettings
from gateway.tags import Tag

# Parts of a configuration that a reload takes over. All others need a restart.
_TAKEN_OVER = {"lines", "sheets", "transfers", "watch"}
# From the place of the file, from `writers_file`, and from all settings.
_DERIVED = {"folder", "writers_state", "digest"}
# Settings of a tag that do not change the meaning of its value. After a change of any other one
# the value begins again.
_HARMLESS = {"every", "description", "deadband", "publish", "heartbeat", "history"}
_HARMLESS |= {"payload", "write"}
_NAMES = {
    "name": "gateway.name",
    "state_file": "gateway.state",
    "audit_file": "gateway.audit",
    "standby": "gateway.standby",
    "standby_alone": "gateway.standby_alone",
    "secret_file": "gateway.secret_file",
    "writers_file": "writers.file",
}
_SETTINGS = [one.name for one in fields(Tag) if one.init]
_PARTS = {"shaping", "publishing", "origin"}  # settings that have settings


@dataclass(frozen=True, slots=True)
class DeviceChange:
    """A device that changed. Without `old` it is added, without `new` removed.

    Its computed tags are in `Computed`: they follow when all inputs are taken over.
    """

    old: DeviceSettings | None
    new: DeviceSettings | None
    continues: bool = False  # it is the same station on the same line
    renewed: Mapping[Tag, Tag] = field(default_factory=dict)  # old to new: the value goes on

    @property
    def name(self) -> str:
        known = self.new or self.old
        return "" if known is None else known.name

    @property
    def kept(self) -> frozenset[Tag]:
        """The tags that are the same objects in both."""
        return frozenset(_tags(self.old)) & frozenset(_tags(self.new))

    @property
    def gone(self) -> list[Tag]:
        """The tags of `old` that are not in `new`, also those that have a successor there."""
        kept = self.kept
        return [tag for tag in _tags(self.old) if tag not in kept]

    @property
    def started(self) -> list[Tag]:
        """The tags of `new` whose values begin now."""
        others = self.kept | frozenset(self.renewed.values())
        return [tag for tag in _tags(self.new) if tag not in others]


@dataclass(frozen=True, slots=True)
class Computed:
    """Computed tags that begin, and those that have gone, also with a successor."""

    started: Sequence[Tag] = ()
    gone: Sequence[Tag] = ()


@dataclass(frozen=True, slots=True)
class Difference:
    """All changes. `config` has the objects of the old one wherever nothing changed."""

    config: Config
    devices: Mapping[str, DeviceChange]
    closed: Sequence[str]  # lines whose port is closed; a line in both is opened again
    opened: Sequence[LineConfig]
    computed: Computed

    @property
    def renewed(self) -> Mapping[Tag, Tag]:
        """Old tags to those that go on with their values."""
        return {old: new for one in self.devices.values() for old, new in one.renewed.items()}

    def __bool__(self) -> bool:
        computed = self.computed.started or self.computed.gone
        return bool(self.devices or self.closed or self.opened or computed)


def needs_restart(old: Config, new: Config) -> list[str]:
    """Returns the settings that changed and that only a restart takes over."""
    found = [*_changed(old, new, "", _TAKEN_OVER | _DERIVED), *_served(old, new), *_kept(old, new)]
    return list(dict.fromkeys(found))


def _kept(old: Config, new: Config) -> Iterator[str]:
    """Yields the devices that changed and have totals or debounced bits: these count reads."""
    before = {device.name: (_port(line), device) for line in old.lines for device in line.devices}
    after = {device.name: (_port(line), device) for line in new.lines for device in line.devices}
    for name in before | after:
        both = [one for one in (before.get(name), after.get(name)) if one is not None]
        counts = any(tag.origin.kept is not None for _, device in both for tag in device.tags)
        if counts and (len(both) < 2 or not _alike(*both)):
            yield f"{name}, which has totals or debounced bits,"


def _served(old: Config, new: Config) -> Iterator[str]:
    """Yields the lines that answer and changed: their masters would see a half of it."""
    before = {line.name: line for line in old.lines if line.serve}
    after = {line.name: line for line in new.lines if line.serve}
    for name in before | after:
        if not _alike(before.get(name), after.get(name)):
            yield f"lines.{name}"


def _alike(one: Any, other: Any) -> bool:
    """Compares plain data. Tags are equal to themselves only, so their settings count."""
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_alike, one, other))
    if is_dataclass(one) and type(one) is type(other):
        names = [a.name for a in fields(one) if a.init]
        return all(_alike(getattr(one, name), getattr(other, name)) for name in names)
    return bool(one == other)


def _changed(old: Any, new: Any, prefix: str, left_out: set[str]) -> Iterator[str]:
    for one in fields(old):
        before, after = getattr(old, one.name), getattr(new, one.name)
        if one.name in left_out or before == after or not one.init:
            continue
        if one.name == "parts":
            yield from _of_parts(before, after)
            continue
        name = prefix + _NAMES.get(one.name, one.name)
        if is_dataclass(before) and is_dataclass(after):
            yield from _changed(before, after, f"{name}.", set())
        else:
            yield name


def _of_parts(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yields the settings of parts that changed."""
    for name in dict.fromkeys((*old, *new)):
        before, after = old.get(name), new.get(name)
        if isinstance(before, BaseModel) and isinstance(after, type(before)):
            names = dict(after)
            yield from (f"{name}.{one}" for one in names if dict(before)[one] != names[one])
        elif before != after:
            yield name


def compare(old: Config, new: Config) -> Difference:
    """Compares the lines and devices of two configurations."""
    lines = {line.name: line for line in old.lines}
    before = {device.name: device for device in old.devices}
    after = {device.name for device in new.devices}
    devices = {
        name: DeviceChange(device, None) for name, device in before.items() if name not in after
    }
    merged, opened = [], []
    for line in new.lines:
        known = lines.get(line.name)
        if known is None or _port(known) != _port(line) or _hears_others(known, line):
            opened.append(line)
            merged.append(line)
            changes = [DeviceChange(before.get(one.name), one) for one in line.devices]
        elif line.serve:  # it needs a restart, unless nothing changed
            merged.append(known)
            continue
        else:
            here = {device.name for device in known.devices}
            changes = [_change(before.get(d.name), d, same=d.name in here) for d in line.devices]
            merged.append(replace(line, devices=tuple(c.new for c in changes if c.new is not None)))
        devices |= {change.name: change for change in changes if change.new is not change.old}
    stay = {line.name for line in merged} - {line.name for line in opened}
    closed = [name for name in lines if name not in stay]
    config, computed = _with_computed(old, new, replace(new, lines=tuple(merged)))
    return Difference(config, devices, closed, opened, computed)


def _hears_others(known: LineConfig, line: LineConfig) -> bool:
    """True for a listen-only line whose devices changed: it begins to listen again."""
    return line.listen_only and not _alike(known.devices, line.devices)


def _port(line: LineConfig) -> LineConfig:
    return replace(line, devices=())


def _change(old: DeviceSettings | None, new: DeviceSettings, *, same: bool) -> DeviceChange:
    """Compares one device, without its computed tags. `same`: it was on this line."""
    if old is None or not same:
        return DeviceChange(old, new)
    known = {tag.name: tag for tag in (*old.wire_tags, *old.targets)}
    new = replace(new, targets=tuple(_equal(known.get(tag.name), tag) for tag in new.targets))
    tags = tuple(_equal(known.get(tag.name), tag) for tag in new.wire_tags)
    others = tuple(tag for tag in new.tags if tag.origin.formula is not None)
    if tags == old.wire_tags and replace(new, tags=()) == replace(old, tags=()):
        return DeviceChange(old, old)
    if not (old.enabled and new.enabled and _is_one_station(old, new)):
        # No value goes on, so no tag does.
        tags = tuple(tag.copy(tag.device, tag.name) for tag in tags)
        targets = tuple(tag.copy(tag.device, tag.name) for tag in new.targets)
        return DeviceChange(old, replace(new, tags=(*tags, *others), targets=targets))
    renewed = {
        before: tag
        for tag in tags
        if (before := known.get(tag.name)) is not None
        and before is not tag
        and _differ(before, tag) <= _HARMLESS
    }
    new = replace(new, tags=(*tags, *others))
    return DeviceChange(old, new, continues=True, renewed=renewed)


def _with_computed(old: Config, file: Config, merged: Config) -> tuple[Config, Computed]:
    """Gives the computed tags of `file` the inputs that they have in `merged` from now on."""
    known = {tag.key: tag for device in old.devices for tag in _computed(device)}
    wanted = {tag.key: tag for device in file.devices for tag in _computed(device)}
    if not (known or wanted):
        return merged, Computed()
    before = {device.name: device.enabled for device in old.devices}
    stay = {device.name for device in file.devices if before.get(device.name) is device.enabled}
    made = {tag.key: tag for device in merged.devices for tag in _plain(device)}

    def make(tag: Tag) -> Tag:
        if tag.key in made:
            return made[tag.key]
        inputs, same = tuple(make(one) for one in tag.origin.inputs), known.get(tag.key)
        goes_on = same is not None and same.origin.inputs == inputs and tag.device in stay
        if same is not None and goes_on and _differ(same, tag) <= {"inputs"}:
            made[tag.key] = same
        else:
            made[tag.key] = replace(tag, origin=replace(tag.origin, inputs=inputs))
        return made[tag.key]

    final = {key: make(tag) for key, tag in wanted.items()}
    started = [tag for key, tag in final.items() if tag is not known.get(key)]
    gone = [tag for key, tag in known.items() if final.get(key) is not tag]

    def resolved(device: DeviceSettings) -> DeviceSettings:
        own = tuple(tag for tag in final.values() if tag.device == device.name)
        tags = (*_plain(device), *own)
        return device if tags == device.tags else replace(device, tags=tags)

    lines = (replace(line, devices=tuple(map(resolved, line.devices))) for line in merged.lines)
    return replace(merged, lines=tuple(lines)), Computed(started, gone)


def _equal(old: Tag | None, new: Tag) -> Tag:
    return new if old is None or _differ(old, new) else old


def _differ(old: Tag, new: Tag) -> set[str]:
    """Returns the names of the settings that are not equal."""
    found = {name for name in _SETTINGS if getattr(old, name) != getattr(new, name)}
    pairs = [(getattr(old, name), getattr(new, name)) for name in found & _PARTS]
    if "features" in found:
        before, after = ({type(one): one for one in tag.features} for tag in (old, new))
        pairs += [(before.get(kind), after.get(kind)) for kind in before | after]
    for one, other in pairs:
        known = one or other  # a feature that only one tag has is compared with its defaults
        for part in fields(known):
            if getattr(one, part.name, part.default) != getattr(other, part.name, part.default):
                found.add(part.name)
    return found - _PARTS - {"features"}


def _is_one_station(old: DeviceSettings, new: DeviceSettings) -> bool:
    return old.driver == new.driver and old.answerable == new.answerable


def _tags(device: DeviceSettings | None) -> Sequence[Tag]:
    return () if device is None else device.wire_tags


def _plain(device: DeviceSettings) -> Iterator[Tag]:
    return (tag for tag in device.tags if tag.origin.formula is None)


def _computed(device: DeviceSettings) -> Iterator[Tag]:
    return (tag for tag in device.tags if tag.origin.formula is not None)
