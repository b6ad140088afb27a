"""The queue in which requests of clients wait for the line, and the writes that share a request."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

from gateway.engine.device import Device
from gateway.engine.requests import Group, Request, Write
from gateway.engine.runs import run_of
from gateway.protocols.driver import ScatteredWriter, Span

MOST_WAITING = 1000  # requests


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

        def replaced(other: Request) -> bool:
            return isinstance(other, Write) and other.tag is write.tag and other.group is None

        return self._out(replaced)

    def companions(self, write: Write) -> Companions | None:
        """Takes out the next writes to the device that share one request with this one; None: none.

        Scattered addresses share one where the driver writes several spans at once. A run shares
        one in a group only: a refused value of one client must not leave others in doubt.
        """
        group, driver = write.group, write.device.driver
        if not self.waiting or (group is None and not isinstance(driver, ScatteredWriter)):
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
            write.alone = True
            self.waiting.appendleft(write)

    def withdraw(self, device: Device | None = None) -> list[Request]:
        """Takes out all waiting requests, or those to one device."""
        return self._out(lambda request: device is None or request.device is device)

    def of_group(self, group: Group) -> list[Request]:
        """Takes out the waiting writes of a group."""
        return self._out(lambda request: isinstance(request, Write) and request.group is group)

    def has_room(self, count: int) -> bool:
        return len(self.waiting) + count <= MOST_WAITING

    def expired(self, now: float) -> list[Request]:
        """Takes out the requests that have waited too long."""
        return self._out(lambda request: request.expires <= now) if self.waiting else []

    def _out(self, which: Callable[[Request], bool]) -> list[Request]:
        taken = [request for request in self.waiting if which(request)]
        if taken:
            self.waiting = deque(request for request in self.waiting if not which(request))
        return taken
