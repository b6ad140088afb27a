"""Blocks and writes of one line -> the next thing to say on it."""

import heapq
import itertools
import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from gateway.device import Device, Standing, Write
from gateway.planner import Block

PAUSE_FIRST = 1.0
PAUSE_LONGEST = 60.0
SILENT_SHARE = 0.05  # of the wire's time, for all silent stations together
WAITING_WRITES = 1000
URGENT, NOWHERE = -1, -2  # tickets of polls that are in no heap


@dataclass(slots=True, eq=False)
class Poll:
    """A block and when it is due. Times in seconds of the loop's clock."""

    device: Device
    block: Block
    due: float
    tries: int = 0
    setbacks: int = 0  # rounds in a row that got no answer, though the device answers otherwise
    last_good: float | None = None
    asked: float = 0.0  # when it was handed out last
    live: bool = True  # False once the device was planned anew
    ticket: int = NOWHERE  # its one valid place in the queues

    @property
    def every(self) -> float:
        """How often it is asked: less and less where no answer comes."""
        every = self.device.interval(self.block)
        if self.setbacks:
            every = max(every, min(PAUSE_FIRST * 2.0 ** min(self.setbacks, 10), PAUSE_LONGEST))
        return every

    @property
    def deadline(self) -> float:
        return self.due + self.every


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Ask a device we are in doubt about something harmless."""

    device: Device


@dataclass(frozen=True, slots=True)
class Idle:
    """Nothing to say until then, unless a write comes."""

    until: float


Job = Poll | Write | Probe | Idle


class Schedule:
    """Decides who speaks next on one line.

    Writes go first, but not twice in a row while a poll is due. Polls go by earliest deadline,
    over all devices. What somebody wants to see now goes before other polls, but not twice in
    a row while one is due. A late poll is done once, not once per missed period. A device in
    doubt is probed before anything else is asked of it or written to it. A device that was not
    heard yet is probed at once. While polls of others are due, such probes and those of devices
    that have just failed get half of the wire's time. A silent device is left alone but for
    probes at growing pauses, and all silent devices together get at most a twentieth of the
    wire's time while others are there to be served.
    """

    def __init__(self, devices: Sequence[Device], now: float, seed: int = 0) -> None:
        self.devices = devices
        self._random = random.Random(seed)  # noqa: S311  (jitter, not a secret)
        self._order = itertools.count()
        self._waiting: list[tuple[float, int, Poll]] = []  # by due time
        self._ready: list[tuple[float, int, Poll]] = []  # due, by deadline
        self._urgent: deque[Poll] = deque()
        self._polls: dict[Device, list[Poll]] = {}
        self._writes: deque[Write] = deque()
        self._wrote = False
        self._hurried = False
        self._failed_lane = now  # when, with polls of others due, the next may fail
        self._silent_lane = now  # when the next silent one may
        for device in devices:
            self.plan(device, now)

    # What comes in

    def plan(self, device: Device, now: float) -> None:
        """Take over the device's blocks; what is already known of a block is kept."""
        old = {poll.block.span: poll for poll in self._polls.get(device, ())}
        polls = []
        for block in device.blocks:
            known = old.get(block.span)
            if known is None or known.ticket == URGENT:
                polls.append(Poll(device, block, now))
            else:
                polls.append(Poll(device, block, known.due, setbacks=known.setbacks))
            if known is not None:
                polls[-1].last_good = known.last_good
        for poll in old.values():
            poll.live = False
        self._polls[device] = polls
        self._push(polls)

    def replace(self, poll: Poll, blocks: Iterable[Block], now: float) -> None:
        """Ask these blocks instead of the one, at once."""
        if not poll.live:
            return
        poll.live = False
        polls = [Poll(poll.device, block, now, last_good=poll.last_good) for block in blocks]
        kept = [other for other in self._polls[poll.device] if other is not poll]
        self._polls[poll.device] = kept + polls
        self._push(polls)

    def submit(self, write: Write) -> bool:
        """False when too many writes wait already."""
        if len(self._writes) >= WAITING_WRITES:
            return False
        self._writes.append(write)
        return True

    def reachable(self, device: Device, now: float) -> bool:
        """False for a silent device whose next probe is not allowed yet."""
        return device.standing is not Standing.SILENT or self._silent_lane <= now

    def hasten(self, poll: Poll) -> None:
        """Poll this next, after writes: somebody wants to see it now."""
        if poll.device.standing is Standing.SILENT:
            poll.device.next_probe = 0.0  # as soon as the silent devices' share allows
        elif poll.live and poll.device.served and poll.ticket != URGENT:
            poll.ticket = URGENT
            self._urgent.append(poll)

    def polls(self, device: Device) -> Sequence[Poll]:
        return self._polls[device]

    # What to do now

    def next(self, now: float) -> Job:
        self._ripen(now)
        due = bool(self._ready or self._urgent)
        if self._writes and not (self._wrote and due):
            return self._next_write()
        self._wrote = False
        until = self._waiting[0][0] if self._waiting else float("inf")
        for device, allowed in self._strangers(now):
            if allowed <= now or (device.standing is Standing.STARTING and not due):
                return Probe(device)
            until = min(until, allowed)
        return self._next_poll(now) if due else Idle(until)

    def _next_write(self) -> Job:
        write = self._writes[0]
        if write.device.doubtful:
            return Probe(write.device)
        self._writes.popleft()
        self._wrote = True
        return write

    def _next_poll(self, now: float) -> Job:
        hurry = bool(self._urgent) and not (self._hurried and self._ready)
        poll = self._urgent[0] if hurry else self._ready[0][2]
        if poll.device.doubtful:
            other = self._undoubted() if now < self._failed_lane else None
            if other is None:
                return Probe(poll.device)
            poll = other  # its place in the heap is void with its ticket
        elif hurry:
            self._urgent.popleft()
        else:
            heapq.heappop(self._ready)
        self._hurried = hurry
        poll.ticket = NOWHERE
        poll.due = min(poll.due, now)
        poll.asked = now
        return poll

    def _undoubted(self) -> Poll | None:
        """Of the polls that are due the earliest of a device not in doubt."""
        return min(
            (
                poll
                for _, ticket, poll in self._ready
                if poll.ticket == ticket and poll.live and not poll.device.doubtful
            ),
            key=lambda poll: poll.deadline,
            default=None,
        )

    def _strangers(self, now: float) -> Iterator[tuple[Device, float]]:
        """The next device to be probed of those not heard yet and of the silent: from when on."""
        silent: Device | None = None
        for device in self.devices:
            if device.standing is Standing.STARTING and not device.broadcast:
                yield device, self._failed_lane
                break
        for device in self.devices:
            if device.standing is Standing.SILENT and (
                silent is None or device.next_probe < silent.next_probe
            ):
                silent = device
        if silent is not None:
            yield silent, max(silent.next_probe, self._silent_lane)

    # How it went

    def polled(self, poll: Poll, now: float, *, answered: bool = True) -> None:
        """Done for this period, whatever came of it."""
        poll.setbacks = 0 if answered else poll.setbacks + 1
        every = poll.every
        missed = int((poll.asked - poll.due) / every)
        if missed:
            poll.device.record.overruns += missed
        poll.due = (poll.asked if missed or poll.setbacks else poll.due) + every
        poll.tries = 0
        self._push([poll])

    def again(self, poll: Poll) -> None:
        """It ended unclear and may be asked again in its turn."""
        poll.tries += 1
        self._push([poll])

    def withdraw(self, device: Device | None = None) -> list[Write]:
        """The waiting writes (of one device) that will not be sent any more."""
        return self._take_writes(lambda write: device is None or write.device is device)

    def expired(self, now: float) -> list[Write]:
        """The waiting writes nobody waits for any longer; they are forgotten here."""
        return self._take_writes(lambda write: write.expires <= now) if self._writes else []

    def failed(self, now: float, took: float) -> None:
        """A conversation with a device not silent yet ended unclear after `took` seconds."""
        self._failed_lane = now + took

    def silent(self, device: Device, now: float, took: float) -> None:
        """A probe or the last retry failed after `took` seconds on the wire."""
        device.pause = min(max(2 * device.pause, PAUSE_FIRST), PAUSE_LONGEST)
        device.standing = Standing.SILENT
        device.next_probe = now + device.pause * self._random.uniform(0.9, 1.1)
        others = any(other.served for other in self.devices)
        self._silent_lane = now + took * (1 / SILENT_SHARE - 1) if others else now

    def woke(self, device: Device, now: float) -> None:
        """A device not heard before, or silent, answered: everything is asked of it at once."""
        device.pause = 0.0
        for poll in self._polls[device]:
            poll.due = now
            poll.setbacks = 0
        self.plan(device, now)

    def opened(self, now: float) -> None:
        """The line has been opened: every device is to be heard anew."""
        self._failed_lane = self._silent_lane = now
        self._wrote = self._hurried = False

    def _take_writes(self, which: Callable[[Write], bool]) -> list[Write]:
        taken = [write for write in self._writes if which(write)]
        if taken:
            self._writes = deque(write for write in self._writes if not which(write))
        return taken

    def _push(self, polls: Iterable[Poll]) -> None:
        """Polls of a device that is not served wait for `woke`."""
        for poll in polls:
            if poll.live and poll.device.served and poll.ticket != URGENT:
                poll.ticket = next(self._order)
                heapq.heappush(self._waiting, (poll.due, poll.ticket, poll))

    def _ripen(self, now: float) -> None:
        """What has come due; what is not to be asked any more is dropped here."""
        waiting, ready, urgent = self._waiting, self._ready, self._urgent
        while waiting and waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(waiting)
            if poll.ticket == ticket and poll.live:
                heapq.heappush(ready, (poll.deadline, ticket, poll))
        while ready and not (
            ready[0][2].ticket == ready[0][1] and ready[0][2].live and ready[0][2].device.served
        ):
            heapq.heappop(ready)
        while urgent and not (urgent[0].live and urgent[0].device.served):
            urgent.popleft()
