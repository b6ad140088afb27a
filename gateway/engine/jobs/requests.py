"""Requests of clients: writes and commands, and the queue in which they wait for the line."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import NamedTuple

from gateway.engine.device.device import Device
from gateway.engine.device.long_writes import LongWrite, long_write, writes_around
from gateway.engine.jobs.runs import run_of
from gateway.errors import GatewayError, NotSent
from gateway.protocols.capabilities import Controllable, ScatteredWriter
from gateway.protocols.driver import AnyDriver, Span
from gateway.tags import Tag, WriteResult
from gateway.values import Value

WRITE_EXPIRY = 5.0  # seconds after which a waiting request is no longer sent
MOST_WAITING = 1000  # writes and commands
RACE = "other bits of its word that the device changed at this moment may be as before"
MOST_PEEKS = 16  # any client that may read can send them


class Peeked(NamedTuple):
    """Words or bits as they were read; `time` in ns since 1970, `took` in seconds."""

    address: str
    units: list[int]
    time: int
    took: float


class CommandResult(NamedTuple):
    """The reply of a device to a command; `time` in ns since 1970, `took` in seconds."""

    answer: str
    time: int
    took: float


Outcome = WriteResult | str | GatewayError


class Resyncs(NamedTuple):
    """Tokens of the resyncs around a request whose reply could be an extra reply; None: none."""

    before: int | None = None
    after: int | None = None
    spare: int | None = None  # of the resync after a reply that may be the echo of the request


NO_RESYNCS = Resyncs()


@dataclass(slots=True, eq=False)
class Group:
    """Writes of one client to one device. They are sent in their order; after the first that is
    not done none is sent."""

    failed: str = ""  # the tag of the first that was not done

    def fail(self, tag: Tag) -> None:
        """Notes a write that was not done."""
        self.failed = self.failed or tag.name


@dataclass(slots=True, eq=False)
class Write:
    """A value for a tag. Times in seconds of the line's clock."""

    device: Device
    tag: Tag
    units: Sequence[int]
    submitted: float
    within: float = WRITE_EXPIRY
    alone: bool = False  # refused together with others before any was done: now sent alone
    resyncs: Resyncs = NO_RESYNCS
    group: Group | None = None
    masked: bool = False  # the device changes the bits of its word by itself
    value: Value = field(init=False)  # as the device will hold it, rounded to its steps
    long: LongWrite | None = field(init=False, default=None)  # None: one request is enough

    def __post_init__(self) -> None:
        value = self.tag.from_units(self.units)
        self.value = False if value is None else value
        if self.tag.span.size > 1:
            elements = len(value) if isinstance(value, tuple) else 0
            self.long = long_write(self.device.driver, self.tag.span, elements)

    @property
    def expires(self) -> float:
        """The time after which it is not sent, because the client no longer waits."""
        return self.submitted + self.within

    def resync(self, before: int | None, after: int | None, spare: int) -> None:
        """Has resyncs with these tokens sent around it."""
        self.resyncs = Resyncs(before, after, spare)

    def send_alone(self) -> None:
        """Notes that none of the writes that it shared a request with was done."""
        self.alone = True

    def mask(self, *, masked: bool) -> None:
        """Has the device change the bits of the word by itself, or not."""
        self.masked = masked

    @property
    def _races(self) -> bool:
        """True if bits around it are written as they were read."""
        if self.tag.part is not None:
            return not self.masked
        return writes_around(self.device.driver, self.tag.span)

    @property
    def plain(self) -> bool:
        """True if one request is enough, which it can share with other writes."""
        rule = self.tag.write
        needs_more = rule is not None and (rule.verify or rule.repeat)
        return not (self.alone or needs_more) and self.tag.part is None

    @property
    def latest(self) -> bool:
        """True if only the last of several waiting writes is sent. In a group each is sent."""
        return self.group is None and self.tag.write is not None and self.tag.write.latest

    def holds(self, units: Sequence[int]) -> bool:
        """Returns True if `units`, as read back, are the written value."""
        if self.tag.origin.shape is not None:  # bytes are written, a value is read
            return self.tag.decode(units) == self.tag.from_units(self.units)
        if self.tag.part is not None:
            return self.tag.part.of(units[0]) == self.units[0]
        return list(units) == list(self.units)

    def result(
        self, now: float, time: int, *, verified: bool = False, acknowledged: bool = True
    ) -> WriteResult:
        """Returns the result. `now` by the line's clock, `time` in ns since 1970."""
        took, note = now - self.submitted, RACE if self._races else ""
        origin = self.tag.origin.word
        return WriteResult(self.value, time, took, verified, acknowledged, note, origin)


@dataclass(slots=True, eq=False)
class Command:
    """A command to one device: run, stop, loopback, model and others; or a peek at addresses."""

    device: Device
    name: str
    argument: str
    submitted: float
    within: float = WRITE_EXPIRY
    span: Span | None = None  # of a peek: it is read, and nothing changes
    resyncs: Resyncs = NO_RESYNCS

    def resync(self, before: int) -> None:
        """Has a resync with this token sent before it."""
        self.resyncs = Resyncs(before)

    @property
    def broadcast(self) -> bool:
        """True if it goes to all stations, and none replies."""
        driver = self.device.driver
        return isinstance(driver, Controllable) and self.name in driver.broadcast_commands

    @property
    def expires(self) -> float:
        """The time after which it is not sent, because the client no longer waits."""
        return self.submitted + self.within


Request = Write | Command


def after_failed(group: Group) -> NotSent:
    """Returns the outcome of the writes that follow one that was not done."""
    return NotSent(f"not sent, because {group.failed} before it failed")


def why_not_commanded(driver: AnyDriver, command: str, *, control: bool) -> str:
    """Returns the reason to refuse a command; empty if the device accepts it."""
    known = driver.controls if isinstance(driver, Controllable) else frozenset()
    if not known:
        return f"a {driver.protocol} device takes no commands"
    if command not in known:
        return f"{command!r} is none of its commands: {', '.join(sorted(known))}"
    return "" if control else "`control: true` is missing in the file"


def _is_peek(request: Request) -> bool:
    return isinstance(request, Command) and request.span is not None


class Companions(NamedTuple):
    """Writes that share one request. `run`: the addresses that they fill; None: scattered."""

    writes: Sequence[Write]
    run: Span | None


def _scattered(writes: Sequence[Write]) -> int:
    """Returns how many of the first writes to one device fit in one request with several spans.

    A known bad address goes alone: the device would refuse the others with it.
    """
    device = writes[0].device
    driver, bad, spans = device.driver, device.bad_addresses.bad, list[Span]()
    if isinstance(driver, ScatteredWriter):
        for write in writes:
            spans.append(write.tag.span)
            if not write.plain or any(one.overlaps(spans[-1]) for one in bad):
                return len(spans) - 1
            if driver.scattered_write_cost(spans) is None:
                return len(spans) - 1
    return len(spans)


class RequestQueue:
    """The waiting requests of one line. Requests to one device keep their order.

    Peeks wait behind all others, and have places of their own.
    """

    def __init__(self) -> None:
        self.waiting: deque[Request] = deque()

    @property
    def first(self) -> Request:
        return self.waiting[0]

    def take(self) -> Request | None:
        """Takes out the first request to a device that needs no resync."""
        for request in self.waiting:
            if not request.device.health.needs_resync:
                self.waiting.remove(request)
                return request
        return None

    def submit(self, request: Request) -> bool:
        """Adds a request. Returns False if too many of its kind wait already."""
        peeks = self._peeks()
        others = len(self.waiting) - peeks
        if _is_peek(request):
            if peeks >= MOST_PEEKS:
                return False
            self.waiting.append(request)
            return True
        if others >= MOST_WAITING:
            return False
        self.waiting.insert(others, request)
        return True

    def superseded(self, write: Write) -> list[Request]:
        """Takes out the waiting writes that `write` replaces, if its tag has `latest`."""
        if not write.latest:
            return []

        def replaced(other: Request) -> bool:
            return isinstance(other, Write) and other.tag is write.tag and other.group is None

        return self._out(replaced)

    def companions(self, write: Write) -> Companions | None:
        """Takes out the next writes to the device that share one request with this one; None: none.

        Scattered addresses share one where the driver writes several spans at once. A run shares
        one in a group only: a refused value of one client must not leave others in doubt.
        """
        if not self.waiting:
            return None
        group = write.group
        if group is None and not isinstance(write.device.driver, ScatteredWriter):
            return None
        writes = [write]
        for request in self.waiting:
            if request.device is not write.device:
                continue
            if not isinstance(request, Write) or request.group is not group:
                break
            writes.append(request)
        if len(writes) == 1:
            return None
        count, run = (1, None) if group is None else run_of(writes)
        if (scattered := _scattered(writes)) > count:
            count, run = scattered, None
        if count == 1:
            return None
        others = set(writes[1:count])
        self._out(lambda request: request in others)
        return Companions(writes[:count], run)

    def each_alone(self, writes: Sequence[Write]) -> None:
        """Puts back writes of which none was done: now one by one."""
        for write in reversed(writes):
            write.send_alone()
            self.waiting.appendleft(write)

    def withdraw(self, device: Device | None = None) -> list[Request]:
        """Takes out all waiting requests, or those to one device."""
        return self._out(lambda request: device is None or request.device is device)

    def of_group(self, group: Group) -> list[Write]:
        """Takes out the waiting writes of a group."""
        found = [one for one in self.waiting if isinstance(one, Write) and one.group is group]
        if found:
            members = set(found)
            self._out(lambda request: request in members)
        return found

    def has_room(self, count: int) -> bool:
        return len(self.waiting) - self._peeks() + count <= MOST_WAITING

    def _peeks(self) -> int:
        """Counts from the end, where all of them are."""
        return sum(1 for _ in takewhile(_is_peek, reversed(self.waiting)))

    def expired(self, now: float) -> list[Request]:
        """Takes out the requests that have waited too long."""
        return self._out(lambda request: request.expires <= now) if self.waiting else []

    def _out(self, which: Callable[[Request], bool]) -> list[Request]:
        taken = [request for request in self.waiting if which(request)]
        if taken:
            self.waiting = deque(request for request in self.waiting if not which(request))
        return taken
