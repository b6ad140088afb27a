"""Requests of clients: writes and commands, and the queue in which they wait for the line."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.engine.device import Device
from gateway.errors import GatewayError
from gateway.protocols.driver import AnyDriver, Controllable, ScatteredWriter
from gateway.tags import Tag, WriteResult
from gateway.values import Value

WRITE_EXPIRY = 5.0  # seconds after which a waiting request is no longer sent
MOST_WAITING = 1000  # requests


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


NO_RESYNCS = Resyncs()


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
    value: Value = field(init=False)  # as the device will hold it, rounded to its steps

    def __post_init__(self) -> None:
        value = self.tag.from_units(self.units)
        self.value = False if value is None else value

    @property
    def expires(self) -> float:
        """The time after which it is not sent, because the client no longer waits."""
        return self.submitted + self.within

    @property
    def plain(self) -> bool:
        """True if one request is enough, which it can share with other writes."""
        rule = self.tag.write
        needs_more = rule is not None and (rule.verify or rule.repeat)
        return not (self.alone or needs_more) and self.tag.part is None

    @property
    def latest(self) -> bool:
        """True if only the last of several waiting writes is sent."""
        return self.tag.write is not None and self.tag.write.latest

    def holds(self, units: Sequence[int]) -> bool:
        """Returns True if `units`, as read back, are the written value."""
        if self.tag.shape is not None:  # bytes are written, a value is read
            return self.tag.decode(units) == self.tag.from_units(self.units)
        if self.tag.part is not None:
            return self.tag.part.of(units[0]) == self.units[0]
        return list(units) == list(self.units)

    def result(
        self, now: float, time: int, *, verified: bool = False, acknowledged: bool = True
    ) -> WriteResult:
        """Returns the result. `now` by the line's clock, `time` in ns since 1970."""
        return WriteResult(self.value, time, now - self.submitted, verified, acknowledged)


@dataclass(slots=True, eq=False)
class Command:
    """A command to one device: run, stop, loopback, model and others."""

    device: Device
    name: str
    argument: str
    submitted: float
    within: float = WRITE_EXPIRY
    resyncs: Resyncs = NO_RESYNCS

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


def can_share(writes: Sequence[Write]) -> bool:
    """Returns True if all these writes to one device fit in one request.

    A known bad address goes alone: the device would refuse the others with it.
    """
    device = writes[0].device
    driver, spans = device.driver, [write.tag.span for write in writes]
    if not isinstance(driver, ScatteredWriter) or not all(write.plain for write in writes):
        return False
    if any(bad.overlaps(span) for bad in device.bad_addresses.bad for span in spans):
        return False
    return driver.scattered_write_cost(spans) is not None


def why_not_commanded(driver: AnyDriver, command: str, *, control: bool) -> str:
    """Returns the reason to refuse a command; empty if the device accepts it."""
    known = driver.controls if isinstance(driver, Controllable) else frozenset()
    if not known:
        return f"a {driver.protocol} device takes no commands"
    if command not in known:
        return f"{command!r} is none of its commands: {', '.join(sorted(known))}"
    return "" if control else "`control: true` is missing in the file"


class RequestQueue:
    """The waiting requests of one line. Requests to one device keep their order."""

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
        """Adds a request. Returns False if too many requests wait already."""
        if len(self.waiting) >= MOST_WAITING:
            return False
        self.waiting.append(request)
        return True

    def superseded(self, write: Write) -> list[Request]:
        """Takes out the waiting writes that `write` replaces, if its tag has `latest`."""
        if not write.latest:
            return []
        return self._out(lambda other: isinstance(other, Write) and other.tag is write.tag)

    def companions(self, write: Write) -> list[Write]:
        """Takes out the next writes to the device that fit in one request with this one."""
        found: list[Write] = []
        for request in self.waiting:
            if request.device is not write.device:
                continue
            if not isinstance(request, Write) or not can_share([write, *found, request]):
                break
            found.append(request)
        if found:
            self._out(lambda request: request in found)
        return found

    def each_alone(self, writes: Sequence[Write]) -> None:
        """Puts back writes of which none was done: now one by one."""
        for write in reversed(writes):
            write.alone = True
            self.waiting.appendleft(write)

    def withdraw(self, device: Device | None = None) -> list[Request]:
        """Takes out all waiting requests, or those to one device."""
        return self._out(lambda request: device is None or request.device is device)

    def expired(self, now: float) -> list[Request]:
        """Takes out the requests that have waited too long."""
        return self._out(lambda request: request.expires <= now) if self.waiting else []

    def _out(self, which: Callable[[Request], bool]) -> list[Request]:
        taken = [request for request in self.waiting if which(request)]
        if taken:
            self.waiting = deque(request for request in self.waiting if not which(request))
        return taken
