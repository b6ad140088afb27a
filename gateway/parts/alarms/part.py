"""The alarms as a part: judged with each read, kept in a file, published and acknowledged."""

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import orjson

from gateway.config import Config
from gateway.contract import payload
from gateway.contract.interfaces import Keyed
from gateway.errors import BadValue, Busy, NoHistory, Unknown
from gateway.parts.alarms.board import Alarms, Entry
from gateway.parts.alarms.file import AlarmFile
from gateway.parts.alarms.machine import Event, State
from gateway.parts.alarms.settings import AlarmsSection
from gateway.parts.alarms.watched import conditions, tuned
from gateway.plant.part import Audits, Core, Kind
from gateway.tags import Level, Priority, Quality, Sample, Tag
from gateway.tags.scan import Scan
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

LOOK_EVERY = 1.0  # seconds between two looks at the conditions
MOST_SHOWN = 50  # on the status page
_BATCH_SIZE = 500  # alarms in one turn of the loop


class AlarmPart:
    """All alarms of the gateway. As many as the file has tags, devices, lines and transfers."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._plant = core.plant
        self.alarms = Alarms(core.plant.tags(), core.plant.wall)
        self._settings = core.config.part(AlarmsSection) or AlarmsSection()
        self._file = AlarmFile(self._settings.path, self.alarms)
        self.alarms.subscribe(self._changed)

    # -- life --

    async def begin(self) -> None:
        self._watch()
        await self._file.restore()

    async def run(self) -> None:
        async with self._file.kept(), asyncio.TaskGroup() as tasks:
            tasks.create_task(self._look())

    async def _look(self) -> None:
        while True:
            self._watch()
            self.alarms.look()
            await asyncio.sleep(LOOK_EVERY)

    def _watch(self) -> None:
        """Follows the conditions of the plant and of other parts."""
        found = self._plant.doors.conditions
        now = asyncio.get_running_loop().time
        found.put("alarms", conditions(self._plant.lines, self.alarms.level, now))
        self.alarms.watch(tuned(found.all(), self._settings))

    async def take_over(self, config: Config, renewed: Mapping[Tag, Tag]) -> None:
        self._watch()

    def retag(self, tags: Sequence[Tag], gone: Sequence[Tag]) -> None:
        self.alarms.take_over(tags, gone)

    # -- samples --

    @property
    def wants(self) -> bool:
        return self.alarms.of_tags

    def seen(self, samples: Sequence[Sample]) -> None:
        if not (type(samples) is Scan and samples.latest.alarmed == ()):
            self.alarms.judge(samples)

    # -- documents --

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        found: dict[str, Mapping[str, object]] = {"alarms": self.alarms.counts()}
        if self._settings.path is not None:
            found["files/alarms"] = {"trouble": self._file.trouble}
        return found

    def document(self, entry: Entry) -> bytes:
        return payload.document(self._fields(entry))

    def _fields(self, entry: Entry) -> dict[str, object]:
        return alarm_fields(entry, self._plant.sample, self.alarms.parts(entry))

    def _changed(self, entry: Entry, event: Event | None) -> None:
        """`event` None: only the quality of the value has changed."""
        self._publish(entry)
        if event is None:
            return
        fields = {"event": _TOLD.get(event, event), **self._fields(entry)}
        changed = payload.document(fields).decode()
        if event is Event.ACKNOWLEDGED:
            for part in self._core.others.each(Audits):
                part.audit(self._plant.wall(), changed)
        try:
            history = self._core.history()
        except Busy:
            return  # the part that keeps it is a fault already
        if history is not None:
            history.record_alarm(entry.status.since, changed)

    def _publish(self, entry: Entry) -> None:
        """The publishing thread makes the document: a line that is lost changes many at once."""
        self._core.north.publish_latest(f"alarms/{entry.key}", partial(self.document, entry))

    async def publish_all(self) -> None:
        entries = list(self.alarms.entries.values())
        for start in range(0, len(entries), _BATCH_SIZE):
            for entry in entries[start : start + _BATCH_SIZE]:
                self._publish(entry)
            await asyncio.sleep(0)

    def entries(self) -> Sequence[tuple[str, Callable[[], bytes]]]:
        found = list(self.alarms.entries.items())
        return [(key, partial(self.document, entry)) for key, entry in found]

    def recorded(self, time_range: str, now: int) -> Iterator[tuple[str, str]]:
        if (history := self._core.history()) is None:
            raise NoHistory
        for row in history.alarms(time_range, None, now):
            yield str(orjson.loads(row)["alarm"]), row

    # -- operators --

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        """Acknowledges an alarm, and returns when that is on disk.

        Raises `BadValue`, `Unknown`, `NothingToAcknowledge`, and `Busy` if it counts until the next
        restart only. A repeat waits for the disk again.
        """
        name, raised = parse_acknowledgement(data)
        entry = self.alarms.entries.get(path)
        if entry is None:
            raise Unknown(f"there is no alarm {payload.short(path)}")
        seen = entry.status.raised
        if raised is not None and raised != rfc3339(seen):
            seen = -1
        self.alarms.acknowledge(entry.key, name, by, None if raised is None else seen)
        await self._file.keep()
        return self.document(entry)

    def page(self, state: str, after: str | None, most: int) -> Mapping[str, Any]:
        """Returns a page of the list, after the alarm `after`. Any thread may call it.

        `state`: one of `State`, `open` for all that are not normal, or `all`. Raises `BadValue`.
        """
        if state not in ("open", "all", *State):
            raise BadValue(f"state is none of open, all, {', '.join(State)}")
        found = self._select(state)
        if after is not None:
            keys = [entry.key for entry in found]
            found = found[keys.index(after) + 1 :] if after in keys else []
        return {
            "alarms": [self._fields(one) for one in islice(found, most)],
            "counts": self.alarms.counts(),
            "next": found[most - 1].key if len(found) > most else None,
        }

    def _select(self, state: str) -> list[Entry]:
        if state == "open":
            return open_alarms(self.alarms)
        entries = list(self.alarms.entries.values())
        return [one for one in entries if state in ("all", one.status.state.value)]

    def shown(self) -> Mapping[str, Any]:
        """Returns the first alarms that are not normal."""
        found = open_alarms(self.alarms)
        shown = [self._fields(entry) for entry in found[:MOST_SHOWN]]
        return {"alarms": {"shown": shown, "more": max(0, len(found) - MOST_SHOWN)}}


KIND = Kind(AlarmPart, serves=Keyed)


LONGEST_NAME = 100  # characters of an operator's name
_LONGEST = 2000  # bytes of an acknowledgement
_OF_BITS = {Level.ON: True, Level.OFF: False}
_WATCHED = (Level.OFFLINE, Level.DOWN, Level.SILENT, Level.STOPPED)
# In the documents a part has ended, with `part_of`.
_TOLD = {Event.FOLDED: Event.ENDED, Event.UNFOLDED: Event.RAISED}
_URGENT = [*Priority]
# The first alarms of a list: those that nobody has acknowledged.
_ORDER = {State.ACTIVE: 0, State.RETURNED: 1, State.ACKNOWLEDGED: 2, State.NORMAL: 3}


def alarm_fields(
    entry: Entry, sample: Callable[[Tag], Sample], parts: Sequence[Entry] = ()
) -> dict[str, object]:
    """Returns the document of an alarm. Any thread may call it."""
    status = entry.status
    level = None if status.state is State.NORMAL else status.level
    at_change: Value | None = status.value
    if entry.tag is not None:
        known: dict[str, object] = {**payload.sample_fields(sample(entry.tag))}
    else:
        alarm, why = entry.reading
        quality = Quality.BAD if alarm is None else Quality.GOOD
        value = None if alarm is None else bool(alarm)
        known = {"value": value, "quality": quality.value, **({"detail": why} if why else {})}
        at_change = None if at_change is None else bool(at_change)
    by = status.acknowledged
    return {
        "alarm": entry.key,
        "state": status.state.value,
        "level": None if level is None else level.value,
        "limit": _limit(entry, level),
        **known,
        "value_at_change": payload.loggable(at_change),
        "unit": "" if entry.tag is None else entry.tag.label.unit,
        "since": rfc3339(status.since) if status.since else None,
        "raised": rfc3339(status.raised) if status.raised else None,
        "acknowledged": by and {"by": by.by, "time": rfc3339(by.time), "via": by.via},
        "text": entry.text,
        "priority": entry.alarm.rule.priority.value,
        **({"part_of": entry.part_of} if entry.part_of else {}),
        **({"devices": [part.key for part in parts]} if parts else {}),
    }


def _limit(entry: Entry, level: Level | None) -> float | bool | None:
    if level is None or level in _WATCHED:
        return None
    return _OF_BITS.get(level, entry.alarm.rule.limits.get(level))


def open_alarms(alarms: Alarms) -> list[Entry]:
    """Returns the alarms that are not normal: those without acknowledgement first, then by
    priority, then the newest."""

    def place(entry: Entry) -> tuple[int, int, int]:
        status, urgent = entry.status, _URGENT.index(entry.alarm.rule.priority)
        return _ORDER[status.state], urgent, -status.since

    return sorted(alarms.open.values(), key=place)


def parse_acknowledgement(data: bytes) -> tuple[str, str | None]:
    """Returns the operator's name, and the `raised` that the operator saw. Raises `BadValue`."""
    meant = 'send {"by": "the operator\'s name"}'
    if len(data) > _LONGEST:
        raise BadValue(f"the payload has {len(data)} bytes, more than {_LONGEST}")
    try:
        found = orjson.loads(data)
    except orjson.JSONDecodeError:
        raise BadValue(f"the payload is no JSON: {meant}") from None
    if not isinstance(found, dict) or not found.keys() <= {"by", "raised"}:
        raise BadValue(f"the payload is no acknowledgement: {meant}")
    by, raised = found.get("by"), found.get("raised")
    if not isinstance(by, str) or not by.strip():
        raise BadValue(f"the name of the operator is missing: {meant}")
    if len(by) > LONGEST_NAME or not by.isprintable():
        raise BadValue(f"the name of the operator is longer than {LONGEST_NAME}, or not printable")
    if raised is not None and not isinstance(raised, str):
        raise BadValue("raised is no time: send it as the alarm's document has it")
    return by.strip(), raised
