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
    """A device's answer to a command; `time` in ns since 1970, `took` in seconds."""

    answer: str
    time: int
    took: float


Outcome = WriteResult | str | GatewayError


@dataclass(slots=True, eq=False)
class Write:
    """A value for a tag. Times in seconds of the line's clock."""

    device: Device
    tag: Tag
    units: Sequence[int]
    submitted: float
    alone: bool = False  # it was refused together with others: it is sent alone now
    value: Value = field(init=False)  # what the device holds after it, rounded to its steps

    def __post_init__(self) -> None:
        value = self.tag.from_units(self.units)
        self.value = False if value is None else value

    @property
    def expires(self) -> float:
        """When it is no longer sent: its client has given up."""
        return self.submitted + WRITE_EXPIRY

    @property
    def plain(self) -> bool:
        """One exchange is enough, so it may share that exchange with others."""
        rule = self.tag.write
        needs_more = rule is not None and (rule.verify or rule.repeat)
        return not (self.alone or needs_more) and self.tag.address.bit is None

    @property
    def latest(self) -> bool:
        """Of several that wait, only the last is sent."""
        return self.tag.write is not None and self.tag.write.latest

    def holds(self, units: Sequence[int]) -> bool:
        """The device holds what was written. `units`: as read back from it."""
        if self.tag.shape is not None:  # bytes are written, a value is read
            return self.tag.decode(units) == self.tag.from_units(self.units)
        bit = self.tag.address.bit
        if bit is not None:
            return (units[0] >> bit & 1) == self.units[0]
        return list(units) == list(self.units)

    def result(
        self, now: float, time: int, *, verified: bool = False, acknowledged: bool = True
    ) -> WriteResult:
        """It was carried out. `now` by the line's clock, `time` in ns since 1970."""
        return WriteResult(self.value, time, now - self.submitted, verified, acknowledged)


@dataclass(slots=True, eq=False)
class Command:
    """Run, stop, loopback, model ... for one device."""

    device: Device
    name: str
    argument: str
    submitted: float

    @property
    def expires(self) -> float:
        """When it is no longer sent: its client has given up."""
        return self.submitted + WRITE_EXPIRY


Request = Write | Command


def can_share(writes: Sequence[Write]) -> bool:
    """All these writes to one device fit in one exchange."""
    driver = writes[0].device.driver
    if not isinstance(driver, ScatteredWriter) or not all(write.plain for write in writes):
        return False
    return driver.scattered_write_cost([write.tag.span for write in writes]) is not None


def why_not_commanded(driver: AnyDriver, command: str, *, control: bool) -> str:
    """The reason why a device does not take this command; empty where it does."""
    known = driver.controls if isinstance(driver, Controllable) else frozenset()
    if not known:
        return f"a {driver.protocol} device takes no commands"
    if command not in known:
        return f"{command!r} is none of its commands: {', '.join(sorted(known))}"
    return "" if control else "the file does not say `control: true` of it"


class RequestQueue:
    """The waiting requests of one line. Those of one device stay in their order."""

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
        """False when too many requests wait already."""
        if len(self.waiting) >= MOST_WAITING:
            return False
        self.waiting.append(request)
        return True

    def superseded(self, write: Write) -> list[Request]:
        """Takes out the waiting writes that `write` replaces: its tag says `latest`."""
        if not write.latest:
            return []
        return self._out(lambda other: isinstance(other, Write) and other.tag is write.tag)

    def companions(self, write: Write) -> list[Write]:
        """Takes out the device's next writes that fit in one exchange with this one."""
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
        """They were refused together, so none was carried out: they are next, one by one."""
        for write in reversed(writes):
            write.alone = True
            self.waiting.appendleft(write)

    def withdraw(self, device: Device | None = None) -> list[Request]:
        """Takes out the waiting requests (to one device) that will not be sent."""
        return self._out(lambda request: device is None or request.device is device)

    def expired(self, now: float) -> list[Request]:
        """Takes out the requests that have waited too long."""
        return self._out(lambda request: request.expires <= now) if self.waiting else []

    def _out(self, which: Callable[[Request], bool]) -> list[Request]:
        taken = [request for request in self.waiting if which(request)]
        if taken:
            self.waiting = deque(request for request in self.waiting if not which(request))
        return taken
