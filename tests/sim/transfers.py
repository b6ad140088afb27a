"""Runs the transfers of a plant, and judges them."""

import asyncio
import math
import random
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from gateway.contract.keys import Keys
from gateway.engine.device.device import Device
from gateway.engine.jobs.unanswered import LONGEST_WAIT
from gateway.errors import BadValue, GatewayError, Refused
from gateway.northbound.requests.audit import Audit
from gateway.northbound.requests.writes import OwnWrites
from gateway.parts.transfers import Transfers
from gateway.tags import Quality, Sample, Tag, WriteResult
from gateway.tags.transfer import TransferRule
from gateway.values import Value
from tests.sim.arrays import shown
from tests.sim.bus import Bus
from tests.sim.clients import NOT_SENT, Asked, Client
from tests.sim.hostile import DELAYING
from tests.sim.judge import Judge
from tests.sim.net import SimNet
from tests.sim.obeyed import all_times, counts, most_requests, times

SPOKEN = 1.5  # seconds: the longest write, with a resync before and after, and the read before it
LOOP = 0.01  # seconds: the moments of two writes are seen a little later
LOOK = 20.0  # seconds between two looks at the states
MAY_COME = "may yet be done"  # the end of a write that nothing waits for any longer
_DONE = WriteResult.__name__
_NO_CHANCE = random.Random(0)  # for clients that draw nothing


@dataclass(eq=False)
class Row:
    """What the judge knows of a row. Times by the loop's clock."""

    rule: TransferRule
    source: Tag
    writing: bool = False
    written: Value | None = None  # last, by a write that was done or may have been
    at: float = -1.0  # when this write began; before: none was
    sure: bool = False  # it was acknowledged
    instead: bool = False  # it was the substitute
    early: bool = False  # it may have been
    tried: bool = False  # another one after it, which was not done
    changed_at: float = 0.0  # when the source was published with another good value
    seen: Value | None = None
    open: int = 0  # its writes that ended, and may yet be done
    ends: Counter[str] = field(default_factory=Counter)

    def own(self, end: WriteResult | GatewayError, obeyed: int) -> int:
        """Returns how often the PLC obeyed the write that ended now.

        `obeyed`: how often since it began, also an older write that nothing waits for any longer.
        The line keeps their order: with an acknowledged one all older ones have ended.
        """
        done = isinstance(end, WriteResult)
        older = min(self.open, max(0, obeyed - done))
        self.open = 0 if done else self.open - older + (MAY_COME in str(end))
        return obeyed - older


@dataclass(eq=False)
class Carrier:
    """Runs the transfers of a gateway as one of its subscribers. Each of their writes is judged."""

    judge: Judge
    buses: Mapping[str, Bus]  # by device
    devices: Mapping[str, Device]
    outcomes: list[bytes] = field(default_factory=list)
    rows: dict[str, Row] = field(default_factory=dict)

    def __post_init__(self) -> None:
        gateway = self.judge.gateway
        rules = gateway.config.transfers
        tags = {tag.key: tag for tag in self.judge.known}
        self.rows = {f"transfer {rule.number}": Row(rule, tags[rule.source]) for rule in rules}
        own = OwnWrites(Keys("plant", "demo"), gateway, Audit(self.outcomes.append))
        self._plain = own.write
        self.transfers = Transfers(gateway, self.write, rules)
        gateway.subscribe(self)
        gateway.doors.documents.append(self.transfers.documents)

    def publish(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            for row in self.rows.values():
                good = sample.tag is row.source and sample.quality is Quality.GOOD
                if good and sample.value != row.seen:
                    row.seen, row.changed_at = sample.value, self.judge.now
        self.transfers.publish(samples)

    def set_online(self, device: str, online: bool) -> None:
        self.transfers.set_online(device, online)

    # One write

    async def write(self, tag: Tag, value: Value, by: str, within: float) -> WriteResult:
        """Writes as the gateway does, and judges what is carried."""
        row, judge = self.rows[by], self.judge
        if row.writing:
            judge.broke(f"{by} carried a value while its last write was under way")
        fresh = self._fresh(row)
        if tag.device not in self.devices:  # disabled
            row.ends["disabled"] += 1
            return await self._plain(tag, value, by, within)
        early = fresh and value == row.rule.substitute and self._may_be_stale(row)
        if not early:
            self._judge_value(row, value, fresh=fresh)
        station, since = judge.stations[tag.device], judge.now
        read_at = judge.read_at.get(row.source, since)
        known, held = counts(station, tag), shown(tag, station.holds(tag))
        self._count(tag, self.buses[tag.device].carrying)
        row.writing = True
        before = row.written, row.at, row.sure, row.instead, row.early
        row.written, row.at, row.sure, row.instead = value, since, False, not fresh
        row.early = early
        try:
            end: WriteResult | GatewayError = await self._plain(tag, value, by, within)
        except GatewayError as error:
            end = error
        self._count(tag, self.buses[tag.device].carried)
        row.writing, row.sure = False, isinstance(end, WriteResult)
        row.tried = isinstance(end, (*NOT_SENT, Refused, BadValue))
        if row.tried:
            row.written, row.at, row.sure, row.instead, row.early = before
        row.ends[type(end).__name__] += 1
        judge.story.counts[f"carried {type(end).__name__}"] += 1
        self.buses[tag.device].note("carried", by, value, type(end).__name__)
        if fresh and not early:  # a substitute has no age
            self._judge_age(row, tag, since, read_at)
        client = Client(self.devices[tag.device], judge, self.buses[tag.device], _NO_CHANCE, 1.0)
        obeyed = row.own(end, times(station, tag, known))
        await client.judge_end(tag, value, end, Asked(since, 0, True, held), obeyed)
        if isinstance(end, GatewayError):
            raise end
        return end

    def _count(self, tag: Tag, counter: Counter[int]) -> None:
        number = self.buses[tag.device].number_of(self.devices[tag.device])
        counter[number] += most_requests(tag)

    def _fresh(self, row: Row) -> bool:
        sample = self.judge.gateway.mirror[row.source]
        age = self.judge.now - self.judge.read_at.get(row.source, -math.inf)
        return sample.quality is Quality.GOOD and age < row.rule.stale

    def _may_be_stale(self, row: Row) -> bool:
        """The gateway may count the age from an earlier read: after a new plan from the oldest one
        of all tags that are read together now."""
        source, read = row.source, self.judge.read_at
        beside = (t for t in read if (t.device, t.span.area) == (source.device, source.span.area))
        own = read.get(source, self.judge.began)  # it may not have been read yet
        age = self.judge.now - min(map(read.__getitem__, beside), default=-math.inf)
        age = max(age, self.judge.now - own)
        return age >= row.rule.stale - 2 * source.every  # the oldest may be late itself

    def _judge_value(self, row: Row, value: Value, *, fresh: bool) -> None:
        judge, rule, name = self.judge, row.rule, f"transfer {row.rule.number}"
        sample = judge.gateway.mirror[row.source]
        read_at = judge.read_at.get(row.source, judge.began)
        if not fresh:
            if value != rule.substitute or not self._may_be_stale(row):
                age = judge.now - read_at
                judge.broke(
                    f"{name} carried {value!r} of {sample}, {age:.1f} s after its last read"
                )
            elif row.instead and row.at > read_at:
                judge.broke(f"{name} carried its substitute twice")
        elif value != _expected(rule, sample.value):
            judge.broke(f"{name} carried {value!r} in place of {sample.value!r}")
        elif rule.every is None and row.at >= 0.0 and not (row.instead or row.early):
            if row.sure and value == row.written and not row.tried:
                judge.broke(f"{name} carried {value!r} twice")
            elif not row.tried and judge.now - row.at < row.source.every - LOOP:
                judge.broke(f"{name} carried two values in {judge.now - row.at:.3f} s")
            elif row.changed_at < row.at:
                judge.broke(f"{name} carried {value!r} again, but the source did not change")

    def _judge_age(self, row: Row, tag: Tag, since: float, read_at: float) -> None:
        """Checks the age of the value when the PLC got it."""
        judge, bus = self.judge, self.buses[tag.device]
        client = Client(self.devices[tag.device], judge, bus, _NO_CHANCE, 1.0)
        # A bridge holds up requests that were sent in time.
        held = LONGEST_WAIT if isinstance(bus.wire, SimNet) and bus.wire.bridge else 0.0
        for at in all_times(judge.stations[tag.device], tag):
            late = at >= since and at - read_at > row.rule.stale + SPOKEN + held
            if late and bus.hurt_at < since and not client.deaf(tag.device, since, DELAYING):
                judge.broke(
                    f"transfer {row.rule.number} carried a value that was {at - read_at:.1f} s old"
                )

    # States

    async def look_around(self) -> None:
        while True:
            await asyncio.sleep(LOOK)
            documents = self.judge.gateway.status()
            for row in self.rows.values():
                self._look(row, documents[f"transfers/{row.rule.number}"])

    def _look(self, row: Row, said: Mapping[str, object]) -> None:
        fresh, state = self._fresh(row), said["state"]
        self.judge.story.counts[f"transfers {state}"] += 1
        right = fresh is (state != "stale") or (state == "starting" and not row.ends)
        right = right or (state == "stale" and self._may_be_stale(row))
        right = right and (state != "carried" or row.sure) and said["carried"] == row.ends[_DONE]
        right = right or row.ends["disabled"] > 0
        if not right and not row.writing:
            self.judge.broke(f"transfer {row.rule.number} is told as {said}, ended {row.ends}")

    def at_the_end(self) -> None:
        """Checks that all rows carry again, after a time without faults."""
        judge = self.judge
        for row in self.rows.values():
            target = next(tag for tag in judge.known if tag.key == row.rule.target)
            ends = [self.buses[tag.device] for tag in (row.source, target)]
            loaded = any(sum(d.load for d in bus.line.engine.devices) > 1.0 for bus in ends)
            well = judge.gateway.mirror[target].quality is Quality.GOOD and self._fresh(row)
            state = judge.gateway.status()[f"transfers/{row.rule.number}"]["state"]
            if well and not loaded and not row.ends["BadValue"] and state != "carried":
                judge.broke(f"transfer {row.rule.number} is {state} at the end")


def _expected(rule: TransferRule, value: Value | None) -> Value | None:
    if isinstance(value, bool) or not isinstance(value, int):
        return value
    return value + int(rule.offset)
