"""Decides the next job of one line."""

import itertools
import random
from collections.abc import Iterable, Iterator, Sequence

from gateway.engine.device import Device
from gateway.engine.health import PAUSE_LONGEST, State
from gateway.engine.jobs import EXPEDITED, NOT_QUEUED, Idle, LastRead, Poll, Probe
from gateway.engine.poll_queue import PollQueue
from gateway.engine.requests import Request, RequestQueue
from gateway.engine.unanswered import Unanswered
from gateway.planning.planner import Block
from gateway.tags import Tag

NEVER = float("inf")
GOLDEN = 0.6180339887498949  # any number of its multiples is spread evenly
OFFLINE_SHARE = 0.05  # share of the wire time of all offline devices together


class Schedule:
    """Requests, polls and probes of one line, and their order.

    * Requests go first, but not twice in a row while a poll is due. Requests to other devices do
      not wait behind one whose device needs a resync while a device has just failed.
    * Polls go by earliest deadline, over all devices. On an overloaded line the device that has
      used the wire least in recent seconds goes first.
    * An expedited poll goes before other polls, but not twice in a row while one is due.
    * A late poll is done once, not once per missed period.
    * After their first round the polls are spread over their periods.
    * A device that needs a resync is probed before anything else is sent to it.
    * A starting device is probed at once. While polls of others are due, its probes and those of
      devices that have just failed get half of the wire's time.
    * An offline device is probed at growing pauses. All offline devices together get a twentieth
      of the wire's time while others are online.
    """

    def __init__(self, devices: Sequence[Device], now: float, seed: int = 0) -> None:
        self.devices = devices
        self.requests = RequestQueue()
        self.unanswered = Unanswered()
        self._random = random.Random(seed)  # noqa: S311  (jitter, not a secret)
        # The share of its period by which each poll begins early.
        self._phases = (n * GOLDEN % 1 / 2 for n in itertools.count())
        self._queue = PollQueue()
        self._polls: dict[Device, list[Poll]] = {}
        self._readers: dict[Device, dict[Tag, Poll]] = {}  # made at the first call of `reader`
        self._wrote = False
        self._expedited = False
        self._failing_lane = (
            now  # the time of the next request that may fail, while others have due polls
        )
        self._offline_lane = now  # the time of the next probe of an offline device
        for device in devices:
            self.plan(device, now)

    # Changes

    def plan(self, device: Device, now: float) -> None:
        """Makes polls of the blocks of the device. A poll of the same span keeps its due time."""
        before = self._polls.get(device, ())
        old = {poll.block.span: poll for poll in before}
        read = {tag: poll.last.at for poll in before for tag in poll.block.tags}
        seen = {tag for poll in before if poll.last.ever for tag in poll.block.tags}
        polls = []
        for block in device.blocks:
            known = old.get(block.span)
            if known is None or known.ticket == EXPEDITED:
                poll = Poll(device, block, now)
            else:
                poll = Poll(device, block, known.due, missed=known.missed)
                # The block may have been a bad address, which is polled rarely.
                poll.due = min(known.due, now + poll.every)
            ages = (at for tag in block.tags if (at := read.get(tag)) is not None)
            poll.last.at = min(ages, default=None)
            poll.last.ever = not seen.isdisjoint(block.tags)
            polls.append(poll)
        for poll in before:
            poll.live = False
        self._set_polls(device, polls, polls)

    def replace(self, poll: Poll, blocks: Iterable[Block], now: float) -> None:
        """Replaces one poll by polls of these blocks, due at once."""
        if not poll.live:
            return
        poll.live = False
        last = poll.last
        new = [Poll(poll.device, block, now, last=LastRead(last.at, last.ever)) for block in blocks]
        kept = [other for other in self._polls[poll.device] if other is not poll]
        self._set_polls(poll.device, kept + new, new)

    def _set_polls(self, device: Device, polls: list[Poll], new: list[Poll]) -> None:
        self._polls[device] = polls
        self._readers.pop(device, None)
        self._queue.push_all(new)

    def expedite(self, poll: Poll) -> None:
        """Polls this next, after requests, because a client waits for it."""
        if poll.device.health.state is State.OFFLINE:
            poll.device.health.probe_soon()
        elif poll.live and poll.device.health.online:
            self._queue.expedite(poll)

    # Questions

    def reachable(self, device: Device, now: float) -> bool:
        """False for an offline device whose next probe is not allowed yet."""
        return device.health.state is not State.OFFLINE or self._offline_lane <= now

    def polls(self, device: Device) -> Sequence[Poll]:
        return self._polls[device]

    def reader(self, device: Device, tag: Tag) -> Poll | None:
        """Returns the poll that reads this tag of the device, if any."""
        readers = self._readers.get(device)
        if readers is None:
            readers = {tag: poll for poll in self._polls[device] for tag in poll.block.tags}
            self._readers[device] = readers
        return readers.get(tag)

    # The next job

    def next(self, now: float) -> Request | Probe | Poll | Idle:
        due = self._queue.ripen(now)
        if self.requests.waiting and not (self._wrote and due):
            job = self._next_request(now, due)
            if job is not None:
                return job
        self._wrote = False
        waiting = self._queue.waiting
        until = waiting[0][0] if waiting else NEVER
        others = [device for device in self.devices if not device.health.online]
        for device, allowed in self._probes(others) if others else ():
            starting = device.health.state is State.STARTING
            if allowed <= now or (starting and not due):
                return _probe(device)
            until = min(until, allowed)
        return self._next_poll(now) if due else Idle(until)

    def _next_request(self, now: float, due: bool) -> Request | Probe | None:
        first = self.requests.first.device
        if first.health.needs_resync and self._failing_lane <= now:
            return _probe(first)
        request = self.requests.take()
        if request is not None:
            self._wrote = True
            return request
        return None if due else _probe(first)

    def _next_poll(self, now: float) -> Poll | Probe:
        queue = self._queue
        expedited = bool(queue.expedited) and not (self._expedited and queue.due)
        poll = queue.expedited[0] if expedited else queue.due[0][2]
        if not expedited and len(self.devices) > 1 and poll.deadline < now:
            poll = self._fairest(now)
        if poll.device.health.needs_resync:
            other = self._first_without_resync() if now < self._failing_lane else None
            if other is None:
                return _probe(poll.device)
            poll = other
            expedited = False
        self._expedited = poll.expedited = expedited
        return self._hand_out(poll, now)

    def alongside(self, poll: Poll, most: int, now: float) -> list[Poll]:
        """Returns more due polls of the device, if it accepts several requests at once."""
        others = [other for other in self._queue.valid() if other.device is poll.device]
        others.sort(key=lambda other: (other.deadline, other.ticket))
        return [self._hand_out(other, now) for other in others[:most]]

    def _hand_out(self, poll: Poll, now: float) -> Poll:
        if poll.ticket == EXPEDITED:
            self._queue.expedited.remove(poll)
        poll.ticket = NOT_QUEUED  # its entry in the heap is stale now
        if poll.due > now:
            poll.due = now
        poll.asked = now
        listed = poll.block.listed
        if listed:
            poll.register = poll.device.registered != listed
            poll.device.expect_list(listed)
        return poll

    def _fairest(self, now: float) -> Poll:
        """Returns the late poll whose device has recently used the wire least."""
        late = (poll for poll in self._queue.valid() if poll.deadline < now)
        return min(late, key=lambda poll: (poll.device.recent_use(now), poll.deadline))

    def _first_without_resync(self) -> Poll | None:
        """Returns the due poll with the earliest deadline whose device needs no resync."""
        ready = (poll for poll in self._queue.valid() if not poll.device.health.needs_resync)
        return min(ready, key=lambda poll: poll.deadline, default=None)

    def _probes(self, others: Sequence[Device]) -> Iterator[tuple[Device, float]]:
        """Yields the next starting and the next offline device to probe, with the earliest time."""
        for device in others:
            if device.health.state is State.STARTING and not device.broadcast:
                yield device, self._failing_lane
                break
        offline = [device for device in others if device.health.state is State.OFFLINE]
        if offline:
            device = min(offline, key=lambda device: device.health.next_probe)
            yield device, max(device.health.next_probe, self._offline_lane)

    # Results

    def polled(self, poll: Poll, now: float, *, answered: bool = True) -> None:
        """Ends the poll for this period, after a good or a bad read."""
        poll.missed = 0 if answered else poll.missed + 1
        device, block = poll.device, poll.block
        plain = answered and not device.bad_addresses.bad
        every = block.every if plain else poll.every
        behind = int((poll.asked - poll.due) / every)
        if behind:
            device.record.count_overruns(behind)
            poll.counts.overruns += behind
        poll.due = (poll.asked if behind or poll.missed else poll.due) + every
        if not poll.phased:
            poll.phased = True
            poll.due -= every * next(self._phases)
        if poll.last.at is None and block.span not in device.bad_addresses.bad:
            poll.due = min(poll.due, now + PAUSE_LONGEST)  # the cause may have gone
        poll.tries = 0
        self._queue.push(poll)

    def again(self, poll: Poll, when: float | None = None) -> None:
        """Polls again when the deadline is the earliest, or from `when` on."""
        poll.tries += 1
        if when is not None:
            poll.due = when
        self._queue.push(poll)

    def failed(self, now: float, took: float) -> None:
        """Notes an unclear transaction of `took` seconds with a device that is not offline."""
        self._failing_lane = now + took

    def went_offline(self, device: Device, now: float, took: float) -> None:
        """Makes the device offline, after a failed probe or last retry of `took` seconds."""
        device.health.gave_up(now, self._random.uniform(0.9, 1.1))
        others = any(other.health.online for other in self.devices)
        self._offline_lane = now + took * (1 / OFFLINE_SHARE - 1) if others else now

    def came_online(self, device: Device, now: float) -> None:
        """Makes all blocks of a device due, because it came online."""
        for poll in self._polls[device]:
            poll.due = now
            poll.missed = 0
            poll.last.at = None
        self.plan(device, now)
        for poll in self._polls[device]:
            poll.phased = False

    def opened(self, now: float) -> None:
        """Starts again after the line was opened."""
        self._failing_lane = self._offline_lane = now
        self.unanswered.requests.clear()
        self._wrote = self._expedited = False


def _probe(device: Device) -> Probe:
    health = device.health
    return Probe(device, health.outstanding, health.next_probe_token())
