"""The queue in which the requests of clients wait for the line."""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import takewhile

from gateway.engine.device.device import Device
from gateway.engine.device.reply_shapes import ReplyShapes
from gateway.engine.jobs.jobs import WriteTogether
from gateway.engine.jobs.requests import Command, Group, Request, Resyncs, Write
from gateway.engine.jobs.runs import needs_read, run_of, together
from gateway.errors import Refused
from gateway.protocols.capabilities import ScatteredWriter
from gateway.protocols.driver import Span

MOST_WAITING = 1000  # writes and commands
MOST_PEEKS = 16  # any client that may read can send them


def _is_peek(request: Request) -> bool:
    return isinstance(request, Command) and request.span is not None


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

    def take(self, now: float) -> Write | WriteTogether | Command | None:
        """Takes out the first request to a device that needs no resync, with all that it shares a
        transaction with."""
        for request in self.waiting:
            if not request.device.health.needs_resync:
                self.waiting.remove(request)
                job: Write | WriteTogether | Command = request
                if isinstance(request, Write) and self.waiting:
                    job = self._together(request) or request
                if request.device.shapes is not None:
                    _resync_around(job, request.device.shapes, now)
                return job
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

    def _together(self, write: Write) -> WriteTogether | None:
        """Takes out the next writes to the device that share one request with this one; None: none.

        Scattered addresses share one where the driver writes several spans at once. A run shares
        one in a group only: a refused value of one client must not leave others in doubt.
        """
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
        return WriteTogether(write.device, writes[:count], run)

    def each_alone(self, writes: Sequence[Write], refused: Refused) -> None:
        """Puts back writes of which none was done: now one by one."""
        for write in reversed(writes):
            write.send_alone(refused)
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


def _resync_around(job: Write | WriteTogether | Command, shapes: ReplyShapes, now: float) -> None:
    """Notes the request, and adds the resyncs that it needs."""
    device = job.device
    token = device.health.next_probe_token
    if isinstance(job, Command):
        own = None if job.span is None else shapes.of(job.span)
        extra = shapes.may_be_extra(None, now) or (own is not None and shapes.is_recent(own, now))
        if extra and not job.broadcast:
            job.resync(token())
        shapes.sent(own, now)
        _note_resyncs(device, job.span, job.resyncs, now)
        return
    write = job if isinstance(job, Write) else job.writes[0]
    span, units, reads = write.tag.span, write.units, write.part is not None
    if isinstance(job, WriteTogether) and job.run is not None:
        span, reads = job.run, needs_read(job.writes)
        units = together(span, job.writes, [0] * span.size)
    before, after = shapes.written(span, units, reads, now)
    write.resyncs = Resyncs(token() if before else None, token() if after else None)
    if (long := write.long) is not None and not shapes.tells_apart(long, units):
        long.resync_each([token() for _ in long.spans])
    if before or after:
        _note_resyncs(device, span if write.tag.polled else None, write.resyncs, now)


def _note_resyncs(device: Device, near: Span | None, resyncs: Resyncs, now: float) -> None:
    if (before := resyncs.before) is not None:
        device.note_resync(near, before, now, device.spans_beside(near, before))
    if resyncs.after is not None:
        device.note_resync(near, resyncs.after, now)
