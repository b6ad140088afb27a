"""Blocks and writes of one line -> the next thing to say on it."""

import heapq
import itertools
import random
from collections import deque
from collections.abc import Iterable, Iterator, Sequence

from gateway.engine.device import Device, Standing
from gateway.engine.jobs import NOWHERE, PAUSE_FIRST, PAUSE_LONGEST, URGENT, Idle, Job, Poll, Probe
from gateway.engine.requests import OrderQueue
from gateway.planning.planner import Block
from gateway.tags import Tag

GOLDEN = 0.6180339887498949  # its multiples spread evenly, however many there are
SILENT_SHARE = 0.05  # of the wire's time, for all silent stations together
ROOM = 16  # places in a queue beside twice those that count


class Schedule:
    """Decides who speaks next on one line.

    Orders go first, but not twice in a row while a poll is due; behind one for a device in doubt
    those of others do not wait while something has just failed. Polls go by earliest deadline,
    over all devices; when the line is asked for more than it carries, the devices that have had
    the wire for the shortest time of late go first. What somebody wants to see now goes before
    other polls, but not twice in a row while one is due. A late poll is done once, not once per
    missed period. After their first round the polls are spread over their periods. A device in
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
        # By how much of its period each poll begins early.
        self._phases = (n * GOLDEN % 1 / 2 for n in itertools.count())
        self._waiting: list[tuple[float, int, Poll]] = []  # by due time
        self._ready: list[tuple[float, int, Poll]] = []  # due, by deadline
        self._roomy = ROOM  # places in `_waiting` before the void ones are looked for
        self._crowded = ROOM  # the same in `_ready`
        self._urgent: deque[Poll] = deque()
        self._polls: dict[Device, list[Poll]] = {}
        self._readers: dict[Device, dict[Tag, Poll]] = {}  # made when somebody asks
        self.orders = OrderQueue()
        self._wrote = False
        self._hurried = False
        self._failed_lane = now  # when, with polls of others due, the next may fail
        self._silent_lane = now  # when the next silent one may
        for device in devices:
            self.plan(device, now)

    # What comes in

    def plan(self, device: Device, now: float) -> None:
        """Take over the device's blocks; what is already known of a block is kept."""
        before = self._polls.get(device, ())
        old = {poll.block.span: poll for poll in before}
        read = {tag: poll.last_good for poll in before for tag in poll.block.tags}
        seen = {tag for poll in before if poll.seen for tag in poll.block.tags}
        polls = []
        for block in device.blocks:
            known = old.get(block.span)
            if known is None or known.ticket == URGENT:
                polls.append(Poll(device, block, now))
            else:
                polls.append(Poll(device, block, known.due, setbacks=known.setbacks))
                # It may have been an address refused, which is asked for rarely.
                polls[-1].due = min(known.due, now + polls[-1].every)
            ages = (at for tag in block.tags if (at := read.get(tag)) is not None)
            polls[-1].last_good = min(ages, default=None)
            polls[-1].seen = not seen.isdisjoint(block.tags)
        for poll in before:
            poll.live = False
        self._polls[device] = polls
        self._readers.pop(device, None)
        self._push(polls)

    def replace(self, poll: Poll, blocks: Iterable[Block], now: float) -> None:
        """Ask these blocks instead of the one, at once."""
        if not poll.live:
            return
        poll.live = False
        polls = [
            Poll(poll.device, block, now, last_good=poll.last_good, seen=poll.seen)
            for block in blocks
        ]
        kept = [other for other in self._polls[poll.device] if other is not poll]
        self._polls[poll.device] = kept + polls
        self._readers.pop(poll.device, None)
        self._push(polls)

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

    def reader(self, device: Device, tag: Tag) -> Poll | None:
        """What reads this tag of the device; None where nothing does."""
        readers = self._readers.get(device)
        if readers is None:
            readers = {tag: poll for poll in self._polls[device] for tag in poll.block.tags}
            self._readers[device] = readers
        return readers.get(tag)

    # What to do now

    def next(self, now: float) -> Job:
        self._ripen(now)
        due = bool(self._ready or self._urgent)
        if self.orders and not (self._wrote and due):
            order = self._next_order(now, due)
            if order is not None:
                return order
        self._wrote = False
        until = self._waiting[0][0] if self._waiting else float("inf")
        strangers = [device for device in self.devices if not device.served]
        for device, allowed in self._allowed(strangers) if strangers else ():
            if allowed <= now or (device.standing is Standing.STARTING and not due):
                return Probe(device)
            until = min(until, allowed)
        return self._next_poll(now) if due else Idle(until)

    def _next_order(self, now: float, due: bool) -> Job | None:
        first = self.orders.first.device
        if first.doubtful and self._failed_lane <= now:
            return Probe(first)
        order = self.orders.undoubted()
        if order is not None:
            self._wrote = True
            return order
        return None if due else Probe(first)

    def _next_poll(self, now: float) -> Job:
        hurry = bool(self._urgent) and not (self._hurried and self._ready)
        poll = self._urgent[0] if hurry else self._ready[0][2]
        if not hurry and len(self.devices) > 1 and poll.deadline < now:
            poll = self._fairest(now)
        if poll.device.doubtful:
            other = self._undoubted() if now < self._failed_lane else None
            if other is None:
                return Probe(poll.device)
            poll = other
        elif hurry:
            self._urgent.popleft()
        self._hurried = poll.hurried = hurry
        return self._hand_out(poll, now)

    def beside(self, poll: Poll, most: int, now: float) -> list[Poll]:
        """Polls of the same device that are due too, for one that takes several at once."""
        ready = sorted(self._ready)
        alike = [p for _, ticket, p in ready if p.device is poll.device and self._valid(p, ticket)]
        return [self._hand_out(other, now) for other in alike[:most]]

    @staticmethod
    def _hand_out(poll: Poll, now: float) -> Poll:
        poll.ticket = NOWHERE  # with it its place in the heap is void
        poll.due = min(poll.due, now)
        poll.asked = now
        return poll

    def _fairest(self, now: float) -> Poll:
        """Of the polls that are late the one whose device has had the wire least of late."""
        late = (p for _, ticket, p in self._ready if self._valid(p, ticket) and p.deadline < now)
        return min(late, key=lambda poll: (poll.device.recent_use(now), poll.deadline))

    def _undoubted(self) -> Poll | None:
        """Of the polls that are due the earliest of a device not in doubt."""
        return min(
            (
                poll
                for _, ticket, poll in self._ready
                if self._valid(poll, ticket) and not poll.device.doubtful
            ),
            key=lambda poll: poll.deadline,
            default=None,
        )

    def _allowed(self, strangers: Sequence[Device]) -> Iterator[tuple[Device, float]]:
        """The next device to be probed of those not heard yet and of the silent: from when on."""
        silent: Device | None = None
        for device in strangers:
            if device.standing is Standing.STARTING and not device.broadcast:
                yield device, self._failed_lane
                break
        for device in strangers:
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
            poll.overruns += missed
        poll.due = (poll.asked if missed or poll.setbacks else poll.due) + every
        if not poll.phased:
            poll.phased = True
            poll.due -= every * next(self._phases)
        if poll.last_good is None and poll.block.span not in poll.device.refusals.bad:
            poll.due = min(poll.due, now + PAUSE_LONGEST)  # who knows what was the matter
        poll.tries = 0
        self._push([poll])

    def again(self, poll: Poll, when: float | None = None) -> None:
        """It is to be asked again in its turn, or from `when` on."""
        poll.tries += 1
        if when is not None:
            poll.due = when
        self._push([poll])

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
            poll.last_good = None
        self.plan(device, now)
        for poll in self._polls[device]:
            poll.phased = False

    def opened(self, now: float) -> None:
        """The line has been opened: every device is to be heard anew."""
        self._failed_lane = self._silent_lane = now
        self._wrote = self._hurried = False

    def _push(self, polls: Iterable[Poll]) -> None:
        """Polls of a device that is not served wait for `woke`."""
        for poll in polls:
            if poll.live and poll.device.served and poll.ticket != URGENT:
                poll.ticket = next(self._order)
                heapq.heappush(self._waiting, (poll.due, poll.ticket, poll))
        if len(self._waiting) > self._roomy:
            # Polls that were hastened or planned anew left their old places, some until tomorrow.
            self._waiting = [
                place for place in self._waiting if place[2].live and place[2].ticket == place[1]
            ]
            heapq.heapify(self._waiting)
            self._roomy = 2 * len(self._waiting) + ROOM

    def _ripen(self, now: float) -> None:
        """What has come due; what is not to be asked any more is dropped here."""
        waiting, ready, urgent = self._waiting, self._ready, self._urgent
        while waiting and waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(waiting)
            if poll.ticket == ticket and poll.live:
                heapq.heappush(ready, (poll.deadline, ticket, poll))
        while ready and not self._valid(ready[0][2], ready[0][1]):
            heapq.heappop(ready)
        if len(ready) > self._crowded:
            # Behind one that waits long, others come and go and leave their old places.
            ready[:] = [place for place in ready if self._valid(place[2], place[1])]
            heapq.heapify(ready)
            self._crowded = 2 * len(ready) + ROOM
        while urgent and not (urgent[0].live and urgent[0].device.served):
            urgent.popleft()

    @staticmethod
    def _valid(poll: Poll, ticket: int) -> bool:
        return poll.ticket == ticket and poll.live and poll.device.served
