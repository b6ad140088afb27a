"""Jobs that an engine hands to its line, and their results."""

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.twins import Replied
from gateway.engine.jobs.requests import Command, Request, Write
from gateway.errors import BadValue, Busy, DeviceError, LineDown, Refused, Unclear
from gateway.planning.planner import Block
from gateway.protocols.driver import PROOF, Span


@dataclass(frozen=True, slots=True, eq=False)
class Poll:
    """A job: read one block."""

    device: Device
    block: Block
    span: Span  # to be read: that of the block, or a longer one around it
    register: bool = False  # its monitor list must be registered first


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """A job: resync with a device by a harmless request with its own token."""

    device: Device
    outstanding: Span | None  # a late reply to it must not look like the reply to the probe
    token: int
    again: bool = False  # the line has settled: any reply belongs to this probe
    timeout: float | None = None  # of a short probe; None: `reply_timeout` of the device
    brief: float | None = None  # the time-out while a request to another device waits


@dataclass(frozen=True, slots=True, eq=False)
class Identify:
    """A job: ask a device which one it is."""

    device: Device
    token: int | None = None  # of the resync before its tags are read; None: no reply is mistaken
    shape: Hashable = None  # of the last reply, if it is known


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
Unfinished = Poll | Probe | Identify | RequestJob


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
        case Write(tag=tag) | WriteTogether(writes=[Write(tag=tag), *_]) if not tag.polled:
            return None
        case Write(tag=tag):
            return tag.span
        case WriteTogether(writes=[first, *_], run=run) | ReadBack(writes=[first, *_], run=run):
            return run or first.tag.span
        case Confirm(run=run):
            return run
        case Repeat(write=write):
            return write.tag.span
        case Command(span=span):
            return span
    return None


def may_be_told(job: Unfinished) -> tuple[bool, bool]:
    """Returns True if a late reply to the job has the shape of `span_of`, of a resync or of an
    acknowledgement; and True if a resync went with it."""
    match job:
        case Poll():
            return True, False
        case Probe():
            return job.token != PROOF, False
        case Write(tag=tag, long=None):
            return tag.polled, True
        case Command(span=Span()):
            return True, True
    return False, False


# Results


@dataclass(slots=True)
class Traffic:
    """Characters and requests of a job on the wire."""

    sent: int = 0  # characters
    heard: int = 0  # characters
    exchanges: int = 0  # requests with a reply
    turnaround: float = 0.0  # seconds of the station for them, without the characters
    ahead: float = 0.0  # of a reply before its characters could be over, to these; <= 0
    extra: int = 0  # frames of the station that answered no request
    contradicted: bool = False  # one of them could be the reply to the last request, too
    strange: bool = False  # characters arrived that were no part of a reply
    silence: float = math.inf  # seconds before its request, the shortest of several
    replied: Replied | None = None  # the last
    before: tuple[object, ...] = ()  # the replies before the last
    doubtful: bool = False  # a reply may be another one, or the echo of its request


@dataclass(frozen=True, slots=True)
class Resynced:
    """A probe was answered. Its reply differs from that of `told_from` outstanding requests."""

    told_from: int


@dataclass(frozen=True, slots=True)
class Identified:
    """The texts that a device told of itself, by the names of `identity`."""

    told: Mapping[str, Sequence[str]]


@dataclass(frozen=True, slots=True)
class Sent:
    """A write was acknowledged, or sent to stations that never acknowledge."""

    acknowledged: bool = True
    held: Sequence[int] | None = None  # of the tag or run, read back; None: without `verify`
    refused_back: DeviceError | None = None  # reading back was refused
    took: bool = False  # `held` is what the acknowledgement says, not what was read


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


Success = Sequence[int] | Resynced | Identified | Sent | HeldTogether | Settled | str | None
Result = Success | DeviceError | BadValue | LineDown | Busy
