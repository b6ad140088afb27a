"""The alarms as a part: judged with each read, kept in a file, published and acknowledged."""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import orjson

from gateway.config import Config
from gateway.contract import payload
from gateway.contract.interfaces import Keyed
from gateway.errors import BadValue, Busy, NoHistory, Unknown
from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.documents import (
    alarm_fields,
    event_fields,
    open_alarms,
    suppressed_alarms,
)
from gateway.parts.alarms.entry import AUDITED, Entry
from gateway.parts.alarms.file import AlarmFile
from gateway.parts.alarms.machine import Acknowledgement, Event, State, Suppression
from gateway.parts.alarms.orders import Do, Order, parse_order
from gateway.parts.alarms.own_faults import OwnFaults
from gateway.parts.alarms.settings import AlarmsSection
from gateway.parts.alarms.watched import conditions, tuned
from gateway.plant.part import Core, Kind
from gateway.tags import Sample, Tag
from gateway.tags.scan import Scan
from gateway.tags.timestamps import rfc3339

LOOK_EVERY = 1.0  # seconds between two looks at the conditions
FAULTS_EVERY = 5.0  # seconds between two looks at the faults of the gateway
MOST_SHOWN = 50  # on the status page
STATES = ("open", "suppressed", "all", *State)  # of a list
_BATCH_SIZE = 2000  # alarms in one turn of the loop


class AlarmPart:
    """All alarms of the gateway. As many as the file has tags, devices, lines and transfers."""

    def __init__(self, core: Core) -> None:
        self._core = core
        self._plant = core.plant
        self.alarms = Alarms(core.plant.tags(), core.plant.wall)
        self._settings = core.config.part(AlarmsSection) or AlarmsSection()
        self._file = AlarmFile(self._settings.path, self.alarms)
        self._known: tuple[object, ...] = ()  # what the conditions are of
        self._own_faults = OwnFaults()
        self.alarms.subscribe(self._changed)

    # -- life --

    async def begin(self) -> None:
        self._plant.doors.conditions.put("gateway", self._own_faults.conditions())
        self._watch()
        await self._file.restore()

    async def run(self) -> None:
        async with self._file.kept(), asyncio.TaskGroup() as tasks:
            tasks.create_task(self._look())
            tasks.create_task(self._look_at_faults())

    async def _look(self) -> None:
        while True:
            self._watch()
            self.alarms.look()
            await asyncio.sleep(LOOK_EVERY)

    async def _look_at_faults(self) -> None:
        """Waits first: after a start the parts and certificates are not known yet."""
        while True:
            await asyncio.sleep(FAULTS_EVERY)
            self._own_faults.take(await self._core.north.documents(FAULTS_EVERY))

    def _watch(self) -> None:
        """Follows the conditions of the plant and of other parts."""
        found, lines = self._plant.doors.conditions, self._plant.lines
        devices = [device for line in lines for device in line.engine.devices]
        if self._known == (found.version, *lines, *devices):
            return
        now = asyncio.get_running_loop().time
        found.put("alarms", conditions(lines, self.alarms.level, now))
        self._known = (found.version, *lines, *devices)
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
        found: dict[str, Mapping[str, object]] = {"alarms": self.alarms.tally.document()}
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
        changed = payload.document(event_fields(entry, event, self._fields(entry))).decode()
        if event in AUDITED:
            self._core.others.audit(self._plant.wall(), changed)
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

    def past(self, time_range: str, most: int) -> Sequence[Mapping[str, Any]]:
        newest = deque(self.recorded(time_range, self._plant.wall()), maxlen=most)
        return [orjson.loads(row) for _, row in reversed(newest)]

    # -- operators --

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        """Does what an operator orders, and returns when that is on disk.

        Raises `BadValue`, `Unknown`, `NothingToAcknowledge`, and `Busy` if it counts until the next
        restart only. A repeat waits for the disk again.
        """
        order = parse_order(data, self._settings.shelve_at_most)
        entry = self.alarms.entries.get(path)
        if entry is None:
            raise Unknown(f"there is no alarm {payload.short(path)}")
        self._do(order, entry, by)
        await self._file.keep()
        return self.document(entry)

    def _do(self, order: Order, entry: Entry, via: str | None) -> None:
        at, what = self._plant.wall(), entry.status.suppressed
        match order.do:
            case Do.ACKNOWLEDGE:
                seen = None if order.raised is None else entry.status.raised
                if seen is not None and order.raised != rfc3339(seen):
                    seen = -1
                self.alarms.acknowledge(entry.key, order.by, via, seen)
            case Do.SHELVE | Do.OUT_OF_SERVICE:
                is_shelf = order.do is Do.SHELVE
                until = at + round(order.seconds * 1e9) if is_shelf else None
                asked = Suppression(order.by, at, order.reason, until, via)
                self.alarms.suppress(entry, asked, order.seconds if is_shelf else math.inf)
            case Do.UNSHELVE if what is not None and what.until is None:
                raise BadValue(f"alarm {entry.key} is out of service: send do: {Do.IN_SERVICE}")
            case Do.IN_SERVICE if what is not None and what.until is not None:
                raise BadValue(f"alarm {entry.key} is shelved: send do: {Do.UNSHELVE}")
            case _:
                self.alarms.release(entry, Acknowledgement(order.by, at, via))

    def page(self, state: str, after: str | None, most: int) -> Mapping[str, Any]:
        """Returns a page of the list, after the alarm `after`. Any thread may call it.

        `state`: one of `State`, `open` for all that are not normal, `suppressed` for those that
        are shelved or out of service, or `all`. Raises `BadValue`.
        """
        if state not in STATES:
            raise BadValue(f"state is none of {', '.join(STATES)}")
        found = self._select(state)
        if after is not None:
            keys = [entry.key for entry in found]
            found = found[keys.index(after) + 1 :] if after in keys else []
        return {
            "alarms": [self._fields(one) for one in islice(found, most)],
            "counts": self.alarms.tally.counts(),
            "next": found[most - 1].key if len(found) > most else None,
        }

    @property
    def changes(self) -> int:
        return self.alarms.changes

    def one(self, key: str) -> Mapping[str, Any] | None:
        entry = self.alarms.entries.get(key)
        return None if entry is None else self._fields(entry)

    def _select(self, state: str) -> list[Entry]:
        if state == "open":
            return open_alarms(self.alarms)
        if state == "suppressed":
            return suppressed_alarms(self.alarms)
        entries = list(self.alarms.entries.values())
        return [one for one in entries if state in ("all", one.status.state.value)]

    def shown(self) -> Mapping[str, Any]:
        """Returns the first alarms that are not normal."""
        found = open_alarms(self.alarms)
        shown = [self._fields(entry) for entry in found[:MOST_SHOWN]]
        rest = suppressed_alarms(self.alarms)
        suppressed = [self._fields(entry) for entry in rest[:MOST_SHOWN]]
        more = max(0, len(found) - MOST_SHOWN)
        return {"alarms": {"shown": shown, "more": more, "suppressed": suppressed}}


KIND = Kind(AlarmPart, serves=Keyed)
