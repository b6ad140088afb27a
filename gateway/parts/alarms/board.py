"""All alarms of a gateway: judges each read, ends delays, reports changes. On the event loop.

A scan whose tags have no alarm costs one look at the scan.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

import structlog

from gateway.errors import NothingToAcknowledge
from gateway.parts.alarms.entry import Entry, log_change
from gateway.parts.alarms.machine import Acknowledgement, Alarm, Event, Status, Suppression
from gateway.parts.alarms.tally import Tally
from gateway.plant.doors import Condition
from gateway.tags import AlarmRule, Level, Quality, Sample, Tag
from gateway.tags.scan import Scan
from gateway.values import Value

log = structlog.get_logger("gateway")
# Seconds after the end of an alarm until its parts are alarms of their own again: the devices of a
# line that is back reply one after the other.
OWN_AFTER = 10.0
_GOOD, _UNCERTAIN = Quality.GOOD, Quality.UNCERTAIN  # looking up a member takes 0.2 µs


# Receives each change of an alarm. Event None: only the quality of the value has changed.
Sink = Callable[[Entry, Event | None], None]


class Alarms:
    """The alarms of tags, and those of lines and devices that `watch` adds."""

    def __init__(self, tags: Iterable[Tag], wall: Callable[[], int] = time.time_ns) -> None:
        """`wall`: ns since 1970."""
        self.entries: dict[str, Entry] = {}
        self.tally = Tally()
        self.changed = asyncio.Event()  # something is to be saved
        self.changes = 0  # what happened, so far
        self._by_tag: dict[Tag, Entry] = {}
        self._watched: list[Entry] = []
        self._parts: dict[str, list[Entry]] = {}  # by the key of their parent
        self._sinks: list[Sink] = []
        self._wall = wall
        for tag in tags:
            if (rule := tag.feature(AlarmRule)) is not None:
                self._by_tag[tag] = self._add(Entry(tag.key, Alarm(rule), tag))
        self.of_tags = bool(self._by_tag)  # then samples are to be judged

    def watch(self, conditions: Mapping[str, Condition]) -> None:
        """Has one alarm for each condition, and none for others."""
        for entry in [*self._watched]:
            if entry.key not in conditions:
                self._watched.remove(entry)
                self._remove(entry)
        for key, condition in conditions.items():
            known = self.entries.get(key)
            if known is None or known.alarm.rule != condition.rule:
                if known is not None:
                    self._watched.remove(known)
                known = self._renew(key, condition.rule)
                self._watched.append(known)
            known.look = condition.look  # another line or device may have its place
            known.parent = condition.parent
        parts: dict[str, list[Entry]] = {}
        for entry in self._watched:
            parts.setdefault(entry.parent, []).append(entry)
        self._parts = parts

    # -- a changed file --

    def take_over(self, tags: Iterable[Tag], gone: Iterable[Tag]) -> None:
        """Follows changed tags. The alarm of a tag with the same rule goes on."""
        for tag in tags:
            if (rule := tag.feature(AlarmRule)) is None:
                continue
            entry = self.entries.get(tag.key)
            if entry is None or entry.tag is None or entry.tag.feature(AlarmRule) != rule:
                entry = self._renew(tag.key, rule)
            entry.tag = tag
            self._by_tag[tag] = entry
        for tag in gone:
            entry = self._by_tag.pop(tag, None)
            if entry is not None and entry.tag is tag:
                self._remove(entry)
        self.of_tags = bool(self._by_tag)

    def _remove(self, entry: Entry) -> None:
        if entry.timer is not None:
            entry.timer.cancel()
        if self.entries.get(entry.key) is entry:
            del self.entries[entry.key]
            self.tally.drop(entry)
            self.changed.set()

    def _renew(self, key: str, rule: AlarmRule) -> Entry:
        """Replaces an alarm by one with another rule. It stays shelved, or out of service."""
        old, new = self.entries.get(key), Entry(key, Alarm(rule))
        if old is not None:
            self._remove(old)
            if (what := old.status.suppressed) is not None:
                new.alarm.status, new.released_at = Status(suppressed=what), old.released_at
        self._add(new)
        self.tally.count(new)
        return new

    def _add(self, entry: Entry) -> Entry:
        self.entries[entry.key] = entry
        self.tally.add(entry)
        return entry

    def subscribe(self, sink: Sink) -> None:
        self._sinks.append(sink)

    # -- from the lines --

    def judge(self, samples: Sequence[Sample]) -> None:
        """Judges samples that the mirror has stored."""
        if type(samples) is Scan and samples.latest.alarmed is not None:
            tags, values = samples.tags, samples.values
            for place in samples.latest.alarmed:
                quality = _UNCERTAIN if place in samples.outside else _GOOD
                self._apply(self._by_tag[tags[place]], values[place], quality, samples.time)
            return
        for sample in samples:
            if sample.tag.feature(AlarmRule) is not None:
                known = None if sample.quality is Quality.BAD else sample.value
                self._apply(self._by_tag[sample.tag], known, sample.quality, sample.time)

    def _apply(self, entry: Entry, value: Value | None, quality: Quality, at: int) -> None:
        """Applies a value; None: it is bad."""
        alarm = entry.alarm
        before = alarm.quality
        if value is None and before is Quality.BAD:
            return
        if value is not None and quality is before and value == alarm.value:
            return  # the timer ends a delay
        now = asyncio.get_running_loop().time()
        if (event := alarm.elapse(now, at)) is not None:
            self._report(entry, event)
        event = None
        if value is None:
            alarm.suspend(now)
        else:
            event = alarm.judge(value, now, at, quality)
        if event is not None or alarm.quality is not before:
            self._report(entry, event)
        self._set_timer(entry)

    def _set_timer(self, entry: Entry) -> None:
        due, timer = entry.alarm.due, entry.timer
        if timer is not None and timer.when() != due:
            timer.cancel()
            entry.timer = timer = None
        if due is not None and timer is None:
            loop = asyncio.get_running_loop()
            entry.timer = loop.call_at(due, self._elapse, entry)

    def _elapse(self, entry: Entry) -> None:
        entry.timer = None
        now = asyncio.get_running_loop().time()
        if (event := entry.alarm.elapse(now, self._wall())) is not None:
            self._report(entry, event)
        self._set_timer(entry)

    def _report(self, entry: Entry, event: Event | None) -> None:
        if event is not None:
            self.changes += 1
            self.tally.count(entry)
            self.changed.set()
            log_change(entry, event)
        for sink in self._sinks:
            sink(entry, event)
        if event in (Event.RAISED, Event.FOLDED):
            self.tally.note(entry, event, asyncio.get_running_loop().time())
        if event is Event.RAISED:
            for part in self.parts(entry):
                self._fold(part)

    # -- from operators --

    def acknowledge(
        self, key: str, by: str, via: str | None = None, raised: int | None = None
    ) -> Entry:
        """Acknowledges an alarm. Returns it, also for a repeat. Raises `NothingToAcknowledge`, and
        `KeyError` where there is no such alarm."""
        entry = self.entries[key]
        try:
            event = entry.alarm.acknowledge(by, self._wall(), via, raised)
        except NothingToAcknowledge as error:
            why = error
            if entry.status.suppressed is not None:
                why = NothingToAcknowledge("it is shelved, or out of service")
            elif entry.part_of:
                why = NothingToAcknowledge(f"it is part of {entry.part_of}: acknowledge that")
            raise NothingToAcknowledge(f"alarm {key}: {why}") from None
        if event is not None:
            self._report(entry, event)
        return entry

    def suppress(self, entry: Entry, what: Suppression, seconds: float = math.inf) -> None:
        """Shelves an alarm for so long, or takes it out of service."""
        event = entry.alarm.suppress(what)
        entry.released_at = asyncio.get_running_loop().time() + seconds
        self._report(entry, event)

    def release(self, entry: Entry, by: Acknowledgement | None = None) -> None:
        """Puts an alarm back; `by` None: its time has ended. A repeat changes nothing."""
        now, at = asyncio.get_running_loop().time(), self._wall()
        entry.released_at, entry.by = math.inf, by
        if (event := entry.alarm.release(at)) is not None:
            self._report(entry, event)
        if (event := entry.alarm.elapse(now, at)) is not None:
            self._report(entry, event)

    # -- life --

    def restore(self, known: Mapping[str, Status]) -> None:
        """Takes over the alarms before a restart. Call it before the lines begin."""
        for key, status in known.items():
            if (entry := self.entries.get(key)) is not None:
                entry.alarm.restore(status)
                self.tally.count(entry)
                if entry.alarm.is_part:
                    entry.own_from = asyncio.get_running_loop().time() + OWN_AFTER
                if (what := status.suppressed) is not None and what.until is not None:
                    left = max(0, min(what.until - self._wall(), what.until - what.time))
                    entry.released_at = asyncio.get_running_loop().time() + left / 1e9
            else:
                log.info("alarm left out", alarm=key, why="the configuration has no such alarm")

    def statuses(self) -> Mapping[str, Status]:
        """Returns the alarms that a restart must not lose."""
        return {entry.key: entry.status for entry in self.tally.kept()}

    def level(self, key: str) -> Level | None:
        """Returns the level of an alarm that is reached now."""
        entry = self.entries.get(key)
        return entry.status.level if entry is not None and entry.in_alarm else None

    # -- parts: one cause is one alarm --

    def parts(self, parent: Entry) -> list[Entry]:
        """Returns the alarms that are a part of an active one."""
        found = self._parts.get(parent.key, ()) if parent.covers else ()
        return [one for one in found if one.reading.alarm is not False]

    def _fold(self, entry: Entry) -> None:
        now, parent = asyncio.get_running_loop().time(), self.entries.get(entry.parent)
        if parent is not None and parent.covers:
            entry.own_from = now + OWN_AFTER
        returns = entry.reading.alarm is False and entry.alarm.reached is not None
        if now < entry.own_from or (returns and entry.alarm.is_part):
            event = entry.alarm.fold(self._wall())
        else:
            event = entry.alarm.unfold(now, self._wall())
        if event is not None:
            self._report(entry, event)

    def look(self) -> None:
        """Looks at the conditions."""
        now = asyncio.get_running_loop().time()
        self.tally.look(now, self._wall())
        for entry in [one for one in self.tally.kept() if one.released_at <= now]:
            self.release(entry)
        for entry in self._watched:
            self._look(entry)

    def _look(self, entry: Entry) -> None:
        if entry.look is not None:
            before = entry.part_of, entry.status.folded
            entry.reading = entry.look()
            self._apply(entry, entry.reading.alarm, _GOOD, self._wall())
            self._fold(entry)
            if before != (entry.part_of, entry.status.folded):
                self.tally.count(entry)
                self.changed.set()
                self._report(entry, None)

    def close(self) -> None:
        """Cancels the delays."""
        for entry in self.entries.values():
            if entry.timer is not None:
                entry.timer.cancel()
                entry.timer = None
