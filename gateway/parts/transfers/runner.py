"""Runs the transfers: each row is one task that waits for its source and writes to its target."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

import structlog

from gateway.errors import GatewayError
from gateway.parts.transfers.codes import DONE, End, Outcome, outcome_of
from gateway.parts.transfers.documents import TransferDocument
from gateway.parts.transfers.transfer_row import Carry, SourceReading, State, TransferRow
from gateway.plant.doors import Condition, Reading
from gateway.plant.plant import Plant
from gateway.tags import AlarmRule, Level, Quality, Reason, Sample, Tag, WriteResult, bad
from gateway.tags.timestamps import rfc3339
from gateway.tags.transfer import TransferRule
from gateway.values import Value

log: structlog.stdlib.BoundLogger = structlog.get_logger("gateway")

FOLDER = "transfers"  # of the status documents
TRANSFER = "transfer:"  # begins the key of the alarm of a row
ALARM_DELAY = 3.0  # seconds
Document = Mapping[str, object]
# Writes a value as a client does, for a name; after so many seconds nothing is sent any more.
Write = Callable[[Tag, Value, str, float], Awaitable[WriteResult]]


@dataclass(slots=True, eq=False)
class _Running:
    """A row with its tags and its task."""

    rule: TransferRule
    row: TransferRow
    source: Tag | None = None
    target: Tag | None = None
    carried: WriteResult | None = None  # the last one
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    task: asyncio.Task[None] | None = None

    @property
    def name(self) -> str:
        return f"transfer {self.rule.number}"


@dataclass(eq=False)
class Transfers:
    """The rows of the file, a `Subscriber` of the gateway. Belongs to the event loop."""

    _plant: Plant
    _write: Write
    _rules: Sequence[TransferRule]
    _running: list[_Running] = field(default_factory=list)
    _by_source: dict[Tag, list[_Running]] = field(default_factory=dict)
    _ending: set[asyncio.Task[None]] = field(default_factory=set)

    # -- life --

    def start(self) -> None:
        """Starts the rows. Call it when this gateway is active, before its lines begin."""
        self.renew(self._rules, {})

    def renew(self, rules: Sequence[TransferRule], renewed: Mapping[Tag, Tag]) -> None:
        """Takes over the rows of a changed file.

        A row goes on if it says the same and its tags go on: the same ones, or those that `renewed`
        gives for them. Every other row begins again.
        """
        before, self._running, self._by_source = self._running, [], {}
        for rule in rules:
            source, target = self._plant.tag(rule.source), self._plant.target(rule.target)
            if source is None or target is None:
                continue  # of a device that another gateway serves
            known = next(
                (one for one in before if _goes_on(one, rule, source, target, renewed)), None
            )
            if known is None:
                self._begin(rule, source, target)
            else:
                before.remove(known)
                known.rule = rule  # its number may be another one
                self._add(known, source, target)
        for one in before:
            self._leave(one)
        self._watch()

    def _begin(self, rule: TransferRule, source: Tag, target: Tag) -> None:
        now = asyncio.get_running_loop().time()
        one = _Running(rule, TransferRow(rule, now, fills=self._plant.holds(target)))
        self._add(one, source, target)
        self._plant.age(source)  # from now on it is known
        self.publish([self._plant.sample(source)])
        one.task = asyncio.create_task(self._run(one), name=one.name)
        one.task.add_done_callback(partial(_report, one))

    def _add(self, one: _Running, source: Tag, target: Tag) -> None:
        one.source, one.target = source, target
        self._running.append(one)
        self._by_source.setdefault(source, []).append(one)

    def _leave(self, one: _Running) -> None:
        """Ends a row. A write that is under way ends first: its outcome is recorded."""
        one.source = None
        one.wake.set()
        if one.task is not None:
            self._ending.add(one.task)
            one.task.add_done_callback(self._ending.discard)

    def _watch(self) -> None:
        """Has one alarm for each row."""
        wanted = {}
        for one in self._running:
            source, target = one.rule.text
            text = f"{one.name} from {source} to {target} does not work"
            rule = AlarmRule({Level.STOPPED: True}, delay=ALARM_DELAY, text=text)
            wanted[f"{TRANSFER}{one.rule.number}"] = Condition(rule, partial(self._look, one))
        self._plant.doors.conditions.put(FOLDER, wanted)

    async def stop(self) -> None:
        """Ends all rows at once. A write that is under way is reported as unclear."""
        tasks = [one.task for one in self._running if one.task is not None]
        tasks += self._ending
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    # -- from the gateway --

    def publish(self, samples: Sequence[Sample]) -> None:
        """Wakes the rows of changed sources."""
        if not self._by_source:
            return
        for sample in samples:
            for one in self._by_source.get(sample.tag, ()):
                if sample.quality is Quality.GOOD and sample.value is not None:
                    one.row.changed(sample.value)
                one.wake.set()

    def set_online(self, device: str, online: bool) -> None:
        """Wakes the rows whose target replies again."""
        for one in self._running:
            if online and one.target is not None and one.target.device == device:
                one.row.target_online(asyncio.get_running_loop().time())
                one.wake.set()

    # -- one row --

    async def _run(self, one: _Running) -> None:
        loop = asyncio.get_running_loop()
        while one.source is not None:
            one.wake.clear()
            carry = one.row.next(self._reading(one.source), loop.time())
            if carry is not None:
                outcome = await self._carry(one, carry)
                one.row.ended(outcome, loop.time())
                continue
            self._lapse(one, one.source)
            with suppress(TimeoutError):
                at = one.row.wake(loop.time())
                async with asyncio.timeout_at(None if at == math.inf else at):
                    await one.wake.wait()

    def _lapse(self, one: _Running, source: Tag) -> None:
        """Turns a value that a master reads bad with its source; not that of another writer."""
        reading = self._reading(source)
        old = one.row.lapse(reading)
        if old is None or one.target is None:
            return
        held = self._plant.sample(one.target)
        if one.carried is None or held.quality is Quality.BAD or held.time == one.carried.time:
            reason = reading.reason or Reason.OVERDUE
            at = self._plant.wall()
            self._plant.samples([bad(one.target, reason, at, f"{one.name}: {old.why}")])

    def _reading(self, source: Tag) -> SourceReading:
        sample = self._plant.sample(source)
        known = sample.value if sample.quality is Quality.GOOD else None
        return SourceReading(known, self._plant.age(source), sample.reason, sample.detail)

    async def _carry(self, one: _Running, carry: Carry) -> Outcome:
        target, value = one.target, carry.value
        if target is None:
            raise AssertionError(f"{one.name} has no target")
        if not carry.substitute:
            found = one.rule.value(value, whole=target.is_whole)
            if found is None:
                return Outcome(End.REFUSED, None, f"{value} x {one.rule.scale} is too large")
            value = found
        try:
            one.carried = await self._write(target, value, one.name, carry.within)
        except GatewayError as error:
            return outcome_of(error)
        return DONE

    # -- status --

    def _look(self, one: _Running) -> Reading:
        if one.source is None:
            return Reading(None)
        state, _, why = one.row.verdict(self._reading(one.source))
        return Reading(None if state is State.STARTING else state is not State.CARRIED, why)

    def documents(self) -> Mapping[str, Document]:
        """Returns the documents of all rows, by path."""
        return {f"{FOLDER}/{one.rule.number}": self._document(one) for one in self._running}

    def _document(self, one: _Running) -> TransferDocument:
        source = one.source
        if source is None:
            raise AssertionError(f"{one.name} has ended")
        reading = self._reading(source)
        state, code, why = one.row.verdict(reading)
        counts, carried, at = one.row.counts, one.carried, one.row.carried_at
        now = asyncio.get_running_loop().time()
        return {
            "from": one.rule.text[0],
            "to": one.rule.text[1],
            "when": one.rule.when,
            "state": state.value,
            "code": None if code is None else code.value,
            "meaning": "" if code is None else code.sentence,
            "why": why,
            "value": None if carried is None else carried.value,
            "time": None if carried is None else rfc3339(carried.time),
            "last_carried": None if at is None else round(now - at, 1),
            "age": round(reading.age, 3) if reading.age < math.inf else None,
            "carried": counts[End.DONE],
            "not_done": counts[End.NOT_DONE],
            "refused": counts[End.REFUSED],
            "unclear": counts[End.UNCLEAR],
        }


def _goes_on(
    one: _Running, rule: TransferRule, source: Tag, target: Tag, renewed: Mapping[Tag, Tag]
) -> bool:
    if one.source is None or one.target is None or not one.rule.says_same(rule):
        return False
    both = (one.source, source), (one.target, target)
    return all(old is new or renewed.get(old) is new for old, new in both)


def _report(one: _Running, task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()) is not None:
        one.row.last = Outcome(End.UNCLEAR, None, f"internal error: {error!r}")
        log.error("transfer failed", transfer=task.get_name(), exc_info=error)
