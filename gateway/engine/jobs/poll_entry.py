"""The entry of one block in the schedule: when it is read, and how far its polls came."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from gateway.engine.device.device import Device
from gateway.engine.device.probe_pace import PAUSE_FIRST, PAUSE_LONGEST
from gateway.engine.jobs.jobs import Poll
from gateway.planning.planner import Block
from gateway.protocols.driver import Span
from gateway.tags import Sample
from gateway.tags.scan import Scan

NOT_QUEUED, EXPEDITED, ON_DEMAND = -1, -2, -3  # tickets of polls that are in no heap
MEAN_OF = 10  # gaps between two reads
OWED = 3  # replies in a row to a read that had none, before one counts
SLOT = 0.05  # seconds: polls of one slot begin together, so that the program wakes less often


@dataclass(slots=True)
class BlockReads:
    """The last good read of a block, and counts. Times in seconds of the line's clock."""

    at: float | None = None  # the last one; None: the block's values are bad
    ever: bool = False  # the block was read at least once
    owed: int = 0  # replies before one is a value where others may come: the station was silent
    scan: Scan | None = None  # the next read is compared with it; None: with nothing
    count: int = 0  # good ones since it was planned
    overruns: int = 0  # rounds that were skipped because the one before was late
    mean_gap: float = 0.0  # between two good reads, smoothed over about `MEAN_OF`
    worst_gap: float = 0.0

    def take(self, block: Block, units: Sequence[int], now: float, time: int) -> Sequence[Sample]:
        """Returns the samples of a good read. Only units that changed are decoded."""
        if self.at is not None:
            gap = now - self.at
            if gap > self.worst_gap:
                self.worst_gap = gap
            known = self.count or 1
            if known > MEAN_OF:  # `min` would take 600 instructions
                known = MEAN_OF
            self.mean_gap += (gap - self.mean_gap) / known
        self.count += 1
        self.at, self.ever, self.owed = now, True, 0
        if block.of_fields:
            return block.decoder.fields(units, time)
        scan = self.scan
        if scan is None or scan.latest.superseded:
            scan = self.scan = block.decoder.first(units, time)
        elif units is scan.units or units == scan.units:
            scan.time = time
        else:
            scan = self.scan = block.decoder.after(scan, units, time)
        return scan

    def of_part(self) -> "BlockReads":
        """Returns those of a new block with a part of these tags."""
        return BlockReads(self.at, self.ever, self.owed)

    def was_silent(self) -> None:
        """Notes that the station did not reply to a read."""
        self.owed = OWED

    def replied(self) -> None:
        """Notes a reply that came alone. It may be another one."""
        self.owed = max(self.owed - 1, 0)

    def forget(self, now: float) -> float:
        """Forgets the last read, because its values turn bad. Returns their age."""
        age = 0.0 if self.at is None else now - self.at
        self.worst_gap = max(self.worst_gap, age)
        self.at = self.scan = None
        return age

    def restart(self) -> None:
        """Forgets when the last read was: the device comes online with other values."""
        self.at = None

    def compare_with_nothing(self) -> None:
        """Has all units of the next read decoded."""
        self.scan = None

    def count_overruns(self, missed: int) -> None:
        self.overruns += missed


class PolledBlock(Protocol):
    """A block in the schedule, as the other rooms see it."""

    @property
    def block(self) -> Block: ...

    @property
    def asked(self) -> float:
        """When it was sent last, by the line's clock."""
        ...

    @property
    def reads(self) -> BlockReads: ...


@dataclass(slots=True, eq=False)
class PollEntry:
    """One block that is polled. Times by the line's clock."""

    device: Device
    block: Block
    due: float
    missed: int = 0  # rounds in a row without a reply, while the device replies to others
    reads: BlockReads = field(default_factory=BlockReads)
    tries: int = 0
    soon: float = math.inf  # an earlier deadline, because its values are bad
    asked: float = 0.0  # when it was handed out last; later by the time of a late poll it overtook
    ahead: float = 0.0  # seconds by which it overtakes a late poll
    expedited: bool = False  # before its time, because a client waits
    phased: bool = True  # it has found its place in the period
    live: bool = True  # False after the device was planned again
    ticket: int = NOT_QUEUED  # its one valid place in the queues
    job: Poll = field(init=False)  # that the line gets
    _longer: dict[Span, Poll] = field(default_factory=dict)  # jobs for longer spans

    def __post_init__(self) -> None:
        self.job = Poll(self.device, self.block, self.block.span)

    @property
    def every(self) -> float:
        """Seconds until it is due again. They grow while no reply arrives, and no damaged one."""
        every = self.device.interval(self.block)
        if self.missed and not self.device.health.probes.is_alive(self.asked):
            every = max(every, min(PAUSE_FIRST * 2.0 ** min(self.missed, 10), PAUSE_LONGEST))
        return every

    @property
    def deadline(self) -> float:
        """The latest time to start the poll: its interval after due, also for a bad address.

        It is earlier for a block of a long interval without good values.
        """
        return min(self.due + self.block.every, self.soon)

    # Its place

    def queue(self, ticket: int) -> None:
        """Notes its one valid place."""
        self.ticket = ticket

    def retire(self) -> None:
        """Leaves the schedule: another plan reads its tags."""
        self.live = False

    def due_by(self, when: float) -> None:
        """Makes it due at `when` at the latest."""
        self.due = min(self.due, when)

    def put_off(self, when: float) -> None:
        """Makes it due at `when` at the earliest: its device is left alone until then."""
        self.due = max(self.due, when)

    def hasten(self, deadline: float) -> None:
        """Gives it an earlier deadline; `inf`: that of its interval."""
        self.soon = deadline

    def overtake(self, ahead: float) -> None:
        """Goes before a late poll. It is due so much later then: it is read no more often."""
        self.ahead = ahead

    def hand_out(self, now: float, *, expedited: bool = False) -> "PollEntry":
        """Begins a poll: `job` is what the line has to read."""
        self.ticket = NOT_QUEUED  # its entry in the heap is stale now
        if self.due > now:
            self.due = now
        self.asked, self.ahead, self.expedited = now + self.ahead, 0.0, expedited
        block, device, job = self.block, self.device, self.job
        shapes = device.shapes
        span = block.span if shapes is None else shapes.polled(block, now)
        if block.listed:
            register = device.monitor.must_register(block.listed)
            if register is not job.register:
                self.job = Poll(device, block, span, register)
        elif span is not job.span:
            longer = self._longer.get(span)
            if longer is None:
                longer = self._longer[span] = Poll(device, block, span)
            self.job = longer
        return self

    # Its results

    def read(
        self, units: Sequence[int], now: float, time: int, phases: Iterator[float] | None
    ) -> Sequence[Sample]:
        """Ends a good read of `job`, and returns its samples. `phases`: as in `ended`."""
        span, read = self.block.span, self.job.span
        if read is not span:
            begin = span.start - read.start
            units = units[begin : begin + span.size]
        samples = self.reads.take(self.block, units, now, time)
        self.ended(now, True, phases)
        return samples

    def ended(self, now: float, answered: bool, phases: Iterator[float] | None) -> None:
        """Makes it due again, after a good or a bad read.

        `phases`: the shares of the period by which the next blocks begin early, so that polls are
        spread over it; None: they are not spread.
        """
        device, block = self.device, self.block
        if answered:
            self.missed = 0
            every = self.every if device.bad_addresses.bad else block.every
        else:
            self.missed += 1
            self.reads.was_silent()
            every = self.every
        asked, self.tries = self.asked, 0
        if asked - self.due >= every:
            behind = int((asked - self.due) / every)
            device.record.count_overruns(behind)
            self.reads.count_overruns(behind)
            self.due = asked + every
        else:
            self.due = (asked if self.missed else self.due) + every
        if phases is not None and not self.phased:
            self.phased = True
            due = self.due - every * next(phases)
            self.due = due - due % SLOT
        if self.reads.at is None and block.span not in device.bad_addresses.bad:
            self.due_by(now + PAUSE_LONGEST)  # the cause may have gone

    def try_again(self, when: float | None, *, counted: bool) -> None:
        """Notes that the same read is repeated, from `when` on."""
        self.tries += counted
        self.device.record.count_retry()
        if when is not None:
            self.due = when

    def forget(self, now: float) -> float:
        """Forgets the last read, because its values turn bad. Returns their age."""
        self.device.record.recent.was_good(self.reads.at)
        return self.reads.forget(now)

    def came_online(self, now: float) -> None:
        """Is due at once, because its device came online. Its values are bad."""
        self.due, self.missed, self.tries = now, 0, 0
        self.device.record.recent.was_good(self.reads.at)
        self.reads.restart()

    def spread(self) -> None:
        """Takes another place in the period after its next read."""
        self.phased = False
