"""Blocks and writes of one line -> the next thing to say on it."""

import heapq
import itertools
import random
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gateway.device import Device, Standing, Write
from gateway.planner import Block

PAUSE_FIRST = 1.0
PAUSE_LONGEST = 60.0
SILENT_SHARE = 0.05  # of the wire's time, for all silent stations together
WAITING_WRITES = 1000


@dataclass(slots=True, eq=False)
class Poll:
    """A block and when it is due. Times in seconds of the loop's clock."""

    device: Device
    block: Block
    due: float
    tries: int = 0
    last_good: float | None = None
    live: bool = True  # False once the device was planned anew
    ticket: int = -1  # its one valid place in the queues

    @property
    def deadline(self) -> float:
        return self.due + self.device.interval(self.block)


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
    over all devices. A late poll is done once, not once per missed period. A device in doubt
    is probed before anything else is asked of it or written to it. A silent device is
    left alone but for probes at growing pauses, and all silent devices together get
    at most a twentieth of the wire's time while others are there to be served.
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
        self._silent_lane = now  # when the next probe of a silent device may go
        for device in devices:
            self.plan(device, now)

    # What comes in

    def plan(self, device: Device, now: float) -> None:
        """Take over the device's blocks; what is already known of a block is kept."""
        old = {poll.block.span: poll for poll in self._polls.get(device, ())}
        for poll in old.values():
            poll.live = False
        polls = []
        for block in device.blocks:
            known = old.get(block.span)
            due = now if known is None else known.due
            last = None if known is None else known.last_good
            polls.append(Poll(device, block, due, last_good=last))
        self._polls[device] = polls
        self._push(polls)

    def replace(self, poll: Poll, blocks: Iterable[Block], now: float) -> None:
        """Ask these blocks instead of the one, at once."""
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

    def hasten(self, poll: Poll) -> None:
        """Poll this next, after writes: somebody wants to see it now."""
        if poll.live and poll not in self._urgent:
            poll.ticket = -1
            self._urgent.append(poll)

    def polls(self, device: Device) -> Sequence[Poll]:
        return self._polls[device]

    # What to do now

    def next(self, now: float) -> Job:
        self._ripen(now)
        if self._writes and not (self._wrote and (self._ready or self._urgent)):
            return self._next_write()
        self._wrote = False
        while self._urgent:
            poll = self._urgent.popleft()
            if poll.live:
                return self._ask(poll, now, urgent=True)
        while self._ready:
            _, ticket, poll = self._ready[0]
            if poll.ticket == ticket and poll.live and poll.device.standing is not Standing.SILENT:
                return self._ask(poll, now)
            heapq.heappop(self._ready)
        return self._next_probe(now)

    def _next_write(self) -> Job:
        write = self._writes[0]
        if write.device.doubtful:
            return Probe(write.device)
        self._writes.popleft()
        self._wrote = True
        return write

    def _ask(self, poll: Poll, now: float, *, urgent: bool = False) -> Job:
        if poll.device.doubtful:
            if urgent:
                self._push([poll])
            return Probe(poll.device)
        if not urgent:
            heapq.heappop(self._ready)
        poll.due = min(poll.due, now)
        return poll

    def _next_probe(self, now: float) -> Job:
        silent = [d for d in self.devices if d.standing is Standing.SILENT]
        if not silent:
            return Idle(self._waiting[0][0] if self._waiting else float("inf"))
        first = min(silent, key=lambda device: device.next_probe)
        when = max(first.next_probe, self._silent_lane)
        if when <= now:
            return Probe(first)
        return Idle(min(when, self._waiting[0][0]) if self._waiting else when)

    # How it went

    def polled(self, poll: Poll, now: float) -> None:
        """Done for this period, whatever came of it."""
        every = poll.device.interval(poll.block)
        missed = int((now - poll.due) / every)
        if missed:
            poll.device.record.overruns += missed
        poll.due = max(poll.due + every, now)
        poll.tries = 0
        self._push([poll])

    def again(self, poll: Poll) -> None:
        """It ended unclear and may be asked again in its turn."""
        poll.tries += 1
        self._push([poll])

    def withdraw(self, device: Device | None = None) -> list[Write]:
        """The waiting writes (of one device) that will not be sent any more."""
        mine = [w for w in self._writes if device is None or w.device is device]
        self._writes = deque(w for w in self._writes if w not in mine)
        return mine

    def expired(self, now: float) -> list[Write]:
        """The waiting writes nobody waits for any longer; they are forgotten here."""
        late = [w for w in self._writes if w.expires <= now]
        if late:
            self._writes = deque(w for w in self._writes if w.expires > now)
        return late

    def silent(self, device: Device, now: float, took: float) -> None:
        """A probe or the last retry failed after `took` seconds on the wire."""
        device.pause = min(max(2 * device.pause, PAUSE_FIRST), PAUSE_LONGEST)
        device.standing = Standing.SILENT
        device.next_probe = now + device.pause * self._random.uniform(0.9, 1.1)
        if any(d.standing in (Standing.UP, Standing.FAILING) for d in self.devices):
            self._silent_lane = now + took * (1 / SILENT_SHARE - 1)
        else:
            self._silent_lane = now

    def woke(self, device: Device, now: float) -> None:
        """A silent device answered: everything is asked of it at once."""
        device.pause = 0.0
        for poll in self._polls[device]:
            poll.due = now
        self.plan(device, now)

    def _push(self, polls: Iterable[Poll]) -> None:
        for poll in polls:
            poll.ticket = next(self._order)
            heapq.heappush(self._waiting, (poll.due, poll.ticket, poll))

    def _ripen(self, now: float) -> None:
        while self._waiting and self._waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(self._waiting)
            if poll.live and poll.ticket == ticket:
                heapq.heappush(self._ready, (poll.deadline, ticket, poll))
