"""Jobs that an engine hands to its line, and their results."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

from gateway.engine.device.device import Device
from gateway.engine.device.health import PAUSE_FIRST, PAUSE_LONGEST, State
from gateway.engine.device.records import PollRecord
from gateway.engine.device.reply_shapes import ReplyShapes
from gateway.engine.jobs.requests import Command, Request, Resyncs, Write
from gateway.engine.jobs.runs import needs_read, together
from gateway.errors import BadValue, Busy, DeviceError, LineDown, Refused, Unclear
from gateway.planning.planner import Block
from gateway.protocols.capabilities import UnnumberedReplies
from gateway.protocols.driver import Span
from gateway.tags.scan import Scan

NOT_QUEUED, EXPEDITED, ON_DEMAND = -1, -2, -3  # tickets of polls that are in no heap


@dataclass(slots=True)
class LastRead:
    """The last good read of a block."""

    at: float | None = None  # by the line's clock; None: the block's values are bad
    ever: bool = False  # the block was read at least once
    scan: Scan | None = None  # the next read is compared with it; None: with nothing


@dataclass(slots=True, eq=False)
class Poll:
    """A job: read one block. Also holds its due time and its last read, by the line's clock."""

    device: Device
    block: Block
    due: float
    span: Span = field(init=False)  # to be read: that of the block, or a longer one around it
    tries: int = 0
    missed: int = 0  # rounds in a row without a reply, while the device replies to others
    soon: float = math.inf  # an earlier deadline, because its values are bad
    asked: float = 0.0  # when it was handed out last
    expedited: bool = False  # before its time, because a client waits
    phased: bool = True  # it has found its place in the period
    live: bool = True  # False after the device was planned again
    ticket: int = NOT_QUEUED  # its one valid place in the queues
    register: bool = False  # its monitor list must be registered first
    last: LastRead = field(default_factory=LastRead)
    counts: PollRecord = field(default_factory=PollRecord)

    def __post_init__(self) -> None:
        self.span = self.block.span

    def forget(self, now: float) -> float:
        """Forgets the last read, because its values turn bad. Returns their age."""
        age = 0.0 if self.last.at is None else now - self.last.at
        self.counts.worst_gap = max(self.counts.worst_gap, age)
        self.device.record.was_good(self.last.at)
        self.last.at = self.last.scan = None
        return age

    @property
    def every(self) -> float:
        """Seconds until it is due again. They grow while no reply arrives."""
        every = self.device.interval(self.block)
        if self.missed:
            every = max(every, min(PAUSE_FIRST * 2.0 ** min(self.missed, 10), PAUSE_LONGEST))
        return every

    @property
    def deadline(self) -> float:
        """The latest time to start the poll: its interval after due, also for a bad address.

        It is earlier for a block of a long interval without good values.
        """
        return min(self.due + self.block.every, self.soon)


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """A job: resync with a device by a harmless request with its own token."""

    device: Device
    outstanding: Span | None  # a late reply to it must not look like the reply to the probe
    token: int
    again: bool = False  # the line has settled: any reply belongs to this probe
    timeout: float | None = None  # of a short probe; None: `reply_timeout` of the device


@dataclass(frozen=True, slots=True, eq=False)
class WriteTogether:
    """A job: several writes to one device in one request.

    `run`: the addresses that they fill, of which parts of words are read first, and tags with
    `verify` read back. None: scattered addresses.
    """

    device: Device
    writes: Sequence[Write]
    run: Span | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ReadBack:
    """A job: read back the tags of writes that were refused together, perhaps after a part."""

    device: Device
    writes: Sequence[Write]
    refused: Refused
    run: Span | None = None  # as in `WriteTogether`

    @property
    def error(self) -> Unclear:
        """The end of a write whose tag does not show that it was done."""
        return Unclear(f"refused together with others, perhaps after it was done: {self.refused}")


@dataclass(frozen=True, slots=True, eq=False)
class Confirm:
    """A job: resync, then read back the tag of an unclear write, or the run of several."""

    device: Device
    writes: Sequence[Write]
    run: Span
    error: DeviceError  # the unclear end
    outstanding: Span | None
    token: int


@dataclass(frozen=True, slots=True, eq=False)
class Repeat:
    """A job: the same write again, if the rule of its tag allows it."""

    device: Device
    write: Write
    error: DeviceError  # the unclear end of the first try


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A job: reply to an unsolicited frame. `until`: by the line's clock."""

    device: Device
    frame: bytes
    until: float


RequestJob = Write | WriteTogether | ReadBack | Command | Confirm | Repeat
Unfinished = Poll | Probe | RequestJob


@dataclass(frozen=True, slots=True, eq=False)
class Settle:
    """A job: keep the transaction open and silent, so that a late reply disturbs nothing.

    After a time-out until the late reply has arrived, or for `guard` seconds. After noise until
    `gap` seconds have passed without a byte, at most `guard`.
    """

    device: Device
    guard: float
    gap: float
    after: Unfinished
    error: DeviceError | None = None  # None: the reply may belong to an older request
    before: State = State.ONLINE  # of the device before it failed
    sent: bool = True  # something was sent at all
    failed: Sequence[tuple[Poll, DeviceError]] = ()  # polls of the same transaction


@dataclass(frozen=True, slots=True)
class Idle:
    """No job until then, unless bytes or a request arrive."""

    until: float


@dataclass(frozen=True, slots=True)
class Reopen:
    """Close the port and open it again, because no station has replied for a long time."""

    why: str


Transacted = Unfinished | Answer | Settle
Job = Transacted | Idle | Reopen


@dataclass(slots=True)
class InFlight:
    """The current job of the line, and the job that must follow it."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    charged: Device | None = None  # its use of the wire grows: by polls that were due, and probes
    open_polls: int = 0
    together: int = 0  # polls of the transaction
    failed: list[tuple[Poll, DeviceError]] = field(default_factory=list)
    continuation: Transacted | None = None

    def clear(self) -> None:
        """No job is handed out any more."""
        self.job = self.charged = self.continuation = None
        self.open_polls = 0
        self.failed.clear()

    def resume(self, now: float) -> Transacted:
        """Returns the continuation. All but `Settle` and `Probe` begin their own time."""
        job, self.continuation = self.continuation, None
        if job is None:
            raise AssertionError("no continuation")
        self.job = job
        if isinstance(job, ReadBack | Confirm | Repeat):
            self.begun = now
        return job


def requests_of(job: Job) -> Sequence[Request]:
    """Returns the requests that the job carries out."""
    match job:
        case Write() | Command():
            return (job,)
        case WriteTogether(writes=writes) | ReadBack(writes=writes) | Confirm(writes=writes):
            return writes
        case Repeat(write=write):
            return (write,)
        case Settle(after=after):
            return requests_of(after)
    return ()


def span_of(job: Unfinished) -> Span | None:
    """Returns the span that is outstanding if the job gets no reply; None: the older one stays."""
    match job:
        case Poll():
            return job.span
        case Write(tag=tag):
            return tag.span
        case WriteTogether(writes=[first, *_], run=run) | ReadBack(writes=[first, *_], run=run):
            return run or first.tag.span
        case Confirm(run=run):
            return run
        case Repeat(write=write):
            return write.tag.span
    return None


def resync_around(job: Transacted, shapes: ReplyShapes, now: float) -> None:
    """Notes a request that is no poll, and adds the resyncs that it needs."""
    device, last = job.device, None
    driver = cast("UnnumberedReplies", device.driver)
    token = device.health.next_probe_token
    match job:
        case Write() | WriteTogether():
            write = job if isinstance(job, Write) else job.writes[0]
            span, units, reads = write.tag.span, write.units, write.tag.part is not None
            if isinstance(job, WriteTogether) and job.run is not None:
                span, reads = job.run, needs_read(job.writes)
                units = together(span, job.writes, [0] * span.size)
            before, after = shapes.written(span, units, reads, now)
            write.resyncs = Resyncs(token() if before else None, token() if after else None)
            if (long := write.long) is not None and not shapes.tells_apart(long, units):
                long.tokens = [token() for _ in long.spans]
            return
        case Command():
            before = not job.broadcast and shapes.may_be_extra(None, now)
            job.resyncs = Resyncs(before=token() if before else None)
        case Probe(outstanding=outstanding, token=marked):
            last = driver.resync_shape(outstanding, marked, device.probe_spans)
        case Confirm(run=run):
            last = driver.reply_shape(run)
    shapes.sent(last, now)


# Results


@dataclass(slots=True)
class Traffic:
    """Characters and requests of a job on the wire."""

    sent: int = 0  # characters
    heard: int = 0  # characters
    exchanges: int = 0  # requests with a reply
    turnaround: float = 0.0  # seconds of the station for them, without the characters
    extra: int = 0  # frames of the station that answered no request
    silence: float = math.inf  # seconds before its request, the shortest of several


@dataclass(frozen=True, slots=True)
class Resynced:
    """A probe was answered. Its reply differs from that of `told_from` outstanding requests."""

    told_from: int


@dataclass(frozen=True, slots=True)
class Sent:
    """A write was acknowledged, or sent to stations that never acknowledge."""

    acknowledged: bool = True
    held: Sequence[int] | None = None  # of the tag or run, read back; None: without `verify`
    refused_back: DeviceError | None = None  # reading back was refused


@dataclass(frozen=True, slots=True)
class HeldTogether:
    """The units of several tags that were read back. None: the tag cannot be read."""

    units: Sequence[Sequence[int] | Refused | None]


@dataclass(frozen=True, slots=True)
class Settled:
    """The line has settled. `late`: seconds from the time-out to the late reply, if any.

    `quiet`: False if bytes arrived all the time.
    """

    late: float | None
    quiet: bool = True


Success = Sequence[int] | Resynced | Sent | HeldTogether | Settled | str | None
Result = Success | DeviceError | BadValue | LineDown | Busy
