"""Decides the next job of one line."""

import itertools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.health import Presence, State
from gateway.engine.jobs.jobs import Idle, Probe, WriteTogether
from gateway.engine.jobs.poll_entry import EXPEDITED, ON_DEMAND, BlockReads, PollEntry
from gateway.engine.jobs.request_queue import RequestQueue
from gateway.engine.jobs.requests import Command, Write
from gateway.engine.jobs.unanswered import Unanswered
from gateway.engine.schedule.in_flight import MOST_CHARGED
from gateway.engine.schedule.poll_queue import PollQueue
from gateway.engine.schedule.probe_schedule import ProbeSchedule
from gateway.planning.planner import Block
from gateway.tags import Sample, Tag

NEVER = float("inf")
UNCHANGED: Mapping[Tag, Tag] = {}
LONG = 10.0  # seconds: a longer interval is too long to wait for a first value
ON_DEMAND_SHARE = 0.25  # share of the wire time for polls on demand that delay others
FIRST_SHARE = 0.1  # share of the wire time for blocks of long intervals without good values
GOLDEN = 0.6180339887498949  # any number of its multiples is spread evenly


class Schedule:
    """Requests, polls and probes of one line, and their order.

    * Requests go first, but not twice in a row while a poll is due. Requests to other devices do
      not wait behind one whose device needs a resync while a device has just failed.
    * Polls go by earliest deadline, over all devices. On an overloaded line the device that has
      used the wire least in recent seconds goes first.
    * An expedited poll goes before other polls, but not twice in a row while one is due. Polls on
      demand get a quarter of the wire's time, and more if they end before the next poll is due.
    * A late poll is done once, not once per missed period.
    * A block of a long interval without good values gets an early deadline, in turn with others:
      all these together get a tenth of the wire's time.
    * After their first round the polls are spread over their periods, in slots of 50 ms.
    * A device that needs a resync is probed before anything else is sent to it.
    * A starting device is probed at once, first by a short probe. Devices that have replied last
      time go first. While polls of others are due, these probes and those of devices that have
      just failed get half of the wire's time.
    * An offline device is probed at growing pauses, mostly by short probes. A probe uses idle time
      of the wire if it ends before the next poll is due, or takes no longer than the longest poll.
      Otherwise all offline devices together get a twentieth of the wire's time, one alone of a
      network less.
    * A request to an offline device has it probed at once, when no poll is due.
    """

    def __init__(self, devices: Sequence[Device], now: float, seed: int = 0) -> None:
        self.devices = devices
        self.reaches_by_modem = False  # a modem reaches the devices: docs/modem.md
        self.requests = RequestQueue()
        self.unanswered = Unanswered()
        # The share of its period by which each poll begins early.
        self._phases = (n * GOLDEN % 1 / 2 for n in itertools.count())
        self._probes = ProbeSchedule(devices, now, seed)
        self._queue = PollQueue(shared=len(devices) > 1)
        self._polls: dict[Device, list[PollEntry]] = {}
        self._readers: dict[Device, dict[Tag, PollEntry]] = {}  # made at the first call of `reader`
        self._presence = Presence()
        self._wrote = False
        self._expedited = False
        self._on_demand_lane = now  # until then no poll on demand delays another
        self._on_demand_at = NEVER  # when the poll on demand in flight was sent
        self._first_lane = now  # the deadline of the last block without good values
        for device in devices:
            self.plan(device, now)

    # Changes

    def plan(self, device: Device, now: float, renewed: Mapping[Tag, Tag] = UNCHANGED) -> None:
        """Makes polls of the blocks of the device. A poll of the same span keeps its due time.

        `renewed`: tags of the polls before whose values go on as those of other tags.
        """
        device.health.report(self._presence)
        before = self._polls.get(device, ())
        old = {poll.block.span: poll for poll in before}
        by_tag = [(renewed.get(tag, tag), poll.reads) for poll in before for tag in poll.block.tags]
        read = {tag: reads.at for tag, reads in by_tag}
        seen = {tag for tag, reads in by_tag if reads.ever}
        owed = {tag: reads.owed for tag, reads in by_tag if reads.owed}
        polls = []
        for block in device.blocks:
            known = old.get(block.span)
            ages = (at for tag in block.tags if (at := read.get(tag)) is not None)
            owes = max((owed.get(tag, 0) for tag in block.tags), default=0) if owed else 0
            reads = BlockReads(min(ages, default=None), not seen.isdisjoint(block.tags), owes)
            if known is None or known.ticket <= EXPEDITED:
                poll = PollEntry(device, block, now, reads=reads)
            else:
                poll = PollEntry(device, block, known.due, known.missed, reads, known.tries)
                # The block may have been a bad address, which is polled rarely.
                poll.due_by(now + poll.every)
            polls.append(poll)
        for poll in before:
            poll.retire()
        self._set_polls(device, polls, polls, now)

    def change(self, changes: Changes, now: float) -> None:
        """Takes over changed devices of the line, which are in `devices` already."""
        self._presence.note()
        for old, new in changes.replaced:
            self._polls[new] = self._polls.pop(old)
            self._readers.pop(old, None)
            self.plan(new, now, changes.renewed)
        for device in changes.removed:
            self._readers.pop(device, None)
            for poll in self._polls.pop(device):
                poll.retire()
        expedited = [poll for poll in self._queue.expedited if poll.live]
        self._queue = PollQueue(shared=len(self.devices) > 1)
        self._queue.expedited.extend(expedited)
        for polls in self._polls.values():
            self._queue.push_all(polls)
        for device in changes.added:
            self.plan(device, now)

    def replace(self, poll: PollEntry, blocks: Iterable[Block], now: float) -> None:
        """Replaces one poll by polls of these blocks, due at once."""
        if not poll.live:
            return
        poll.retire()
        device, reads = poll.device, poll.reads
        new = [PollEntry(device, block, now, reads=reads.of_part()) for block in blocks]
        kept = [other for other in self._polls[poll.device] if other is not poll]
        self._set_polls(poll.device, kept + new, new, now)

    def try_soon(self, device: Device, when: float) -> None:
        """Polls all bad addresses of the device before `when`, because one has returned."""
        bad = device.bad_addresses.bad
        later = [p for p in self._polls[device] if p.due > when and p.block.span in bad]
        for poll in later:
            poll.due_by(when)
        self._queue.push_all(later)

    def take_along(self, now: float) -> None:
        """Makes all polls due that are due within half their interval, for one telephone call."""
        polls = (poll for polls in self._polls.values() for poll in polls)
        early = [poll for poll in polls if now < poll.due <= now + poll.block.every / 2]
        for poll in early:
            poll.due_by(now)
        self._queue.push_all(early)

    def _set_polls(
        self, device: Device, polls: list[PollEntry], new: list[PollEntry], now: float
    ) -> None:
        for poll in new:
            self._hasten(poll, now)
        self._polls[device] = polls
        self._readers.pop(device, None)
        self._queue.push_all(new)

    def _hasten(self, poll: PollEntry, now: float) -> None:
        """Gives the poll an early deadline if the values of its block are bad."""
        device, block = poll.device, poll.block
        poll.hasten(NEVER)
        if block.every <= LONG or poll.reads.at is not None or not device.health.online:
            return
        if block.span in device.bad_addresses.bad:
            return
        turn = device.seconds(block.cost) / FIRST_SHARE
        soon = max(self._first_lane, now) + turn
        if max(soon, poll.due + turn) < poll.deadline:
            self._first_lane = soon
            poll.hasten(max(soon, poll.due + turn))

    def expedite(self, poll: PollEntry, *, on_demand: bool = False) -> None:
        """Polls this next, after requests, because a client waits for it."""
        if poll.device.health.state is State.OFFLINE:
            poll.device.health.probes.soon()
        elif poll.live and poll.device.health.online:
            self._queue.expedite(poll, on_demand=on_demand)

    def reach_by_modem(self, by_modem: bool) -> None:
        """Notes if a telephone call is needed for every exchange."""
        self.reaches_by_modem = by_modem

    # Questions

    def reachable(self, device: Device, now: float) -> bool:
        """False for an offline device that is not probed at once for a request."""
        if device.health.state is not State.OFFLINE:
            return True
        return self._probes.reachable(device, now, late=self._queue.is_late)

    def polls(self, device: Device) -> Sequence[PollEntry]:
        return self._polls[device]

    def reader(self, device: Device, tag: Tag) -> PollEntry | None:
        """Returns the poll that reads this tag of the device, if any."""
        readers = self._readers.get(device)
        if readers is None:
            readers = {tag: poll for poll in self._polls[device] for tag in poll.block.tags}
            self._readers[device] = readers
        return readers.get(tag)

    @property
    def is_expedited(self) -> bool:
        """True if a client waits for a poll of an online device."""
        return any(poll.live and poll.device.health.online for poll in self._queue.expedited)

    # The next job

    def next(
        self, now: float, free: Callable[[Device, float], float] | None = None
    ) -> Write | WriteTogether | Command | Probe | PollEntry | Idle:
        """Returns the next job. `free`: when a device may be polled; None: all may be at once."""
        if now >= self._on_demand_at or self._queue.expedited:
            self._share_on_demand(now)
        due = self._queue.ripen(now)
        while due and free is not None and self._held(free, now):
            due = self._queue.ripen(now)
        waiting = self._queue.waiting
        until = waiting[0][0] if waiting else NEVER
        if due and self._queue.due is None and not self._may_expedite(now, until):
            due, until = False, min(until, self._on_demand_lane)
        if self.requests.waiting and not (self._wrote and due):
            job = self._next_request(now, due)
            if job is not None:
                return job
        self._wrote = False
        if self._presence.changed:
            self._presence.look(self.devices)
        if absent := self._presence.absent:
            probe = self._probes.next(absent, now, now if due else until)
            if isinstance(probe, Probe):
                return probe
            until = min(until, probe)
        return self._next_poll(now, free) if due else Idle(until)

    def _held(self, free: Callable[[Device, float], float], now: float) -> bool:
        """Returns True if a poll that goes first is put off, because its device is left alone."""
        queue = self._queue
        for poll in (queue.due, queue.expedited[0] if queue.expedited else None):
            if poll is not None and (when := free(poll.device, now)) > now:
                queue.put_off(poll, when)
                return True
        return False

    def _share_on_demand(self, now: float) -> None:
        """Charges the poll on demand that has ended: others wait three times as long.

        Those that must wait, for that time or behind polls after writes, keep the place that they
        have without a client.
        """
        if now >= self._on_demand_at:
            took, self._on_demand_at = min(now - self._on_demand_at, MOST_CHARGED), NEVER
            lane = max(self._on_demand_lane, now - took)
            self._on_demand_lane = lane + took / ON_DEMAND_SHARE
        if now < self._on_demand_lane or self._queue.keeps_back_on_demand:
            self._queue.return_due(now)

    def _next_request(
        self, now: float, due: bool
    ) -> Write | WriteTogether | Command | Probe | None:
        first = self.requests.first.device
        if first.health.needs_resync:
            probe = self._probes.for_request(first, now, due=due)
            if probe is not None:
                return probe
        request = self.requests.take(now)
        if request is not None:
            self._wrote = True
            return request
        return None if due else self._probes.probe(first, now)

    def _next_poll(
        self, now: float, free: Callable[[Device, float], float] | None
    ) -> PollEntry | Probe:
        queue = self._queue
        poll = queue.due
        first = queue.expedited and not self._expedited and self._may_expedite(now, now)
        if expedited := poll is None or bool(first):
            poll = queue.expedited[0]
        elif (shapes := poll.device.shapes) is not None:
            poll = queue.first_to_differ(poll, shapes, now)
        shapes = poll.device.shapes
        if shapes is not None and shapes.mark_due <= now < shapes.at + shapes.quiet:
            poll.device.health.left_outstanding(shapes.span, now)
        if poll.device.health.needs_resync:
            waits = now < self._probes.failing_lane
            other = self._first_without_resync(now, free) if waits else None
            if other is None:
                return self._probes.probe(poll.device, now)
            poll = other
            expedited = False
        self._expedited = expedited
        if poll.ticket <= EXPEDITED:
            if poll.ticket == ON_DEMAND:
                self._on_demand_at = now
            queue.expedited.remove(poll)
        return poll.hand_out(now, expedited=expedited)

    def _may_expedite(self, now: float, until: float) -> bool:
        """True if the first expedited poll may be sent; another poll is due at `until`."""
        poll = self._queue.expedited[0]
        if now >= self._on_demand_lane or poll.ticket != ON_DEMAND:
            return True
        return now + poll.device.seconds(poll.block.cost) <= until

    def alongside(
        self, device: Device, most: int, now: float, held: Collection[PollEntry] = ()
    ) -> list[PollEntry]:
        """Returns more due polls of the device. `held`: polls that have not ended yet."""
        return [other.hand_out(now) for other in self._queue.more(device, most, held)]

    def _first_without_resync(
        self, now: float, free: Callable[[Device, float], float] | None
    ) -> PollEntry | None:
        """Returns the due poll with the earliest deadline whose device needs no resync, and may be
        polled now."""
        devices = {poll.device for poll in self._queue.valid()}
        good = {one for one in devices if not one.health.needs_resync}
        if free is not None:
            good = {one for one in good if free(one, now) <= now}
        ready = (poll for poll in self._queue.valid() if poll.device in good)
        return min(ready, key=lambda poll: poll.deadline, default=None)

    # Results

    def read(
        self, poll: PollEntry, units: Sequence[int], now: float, time: int
    ) -> Sequence[Sample]:
        """Ends the poll for this period, after a good read. Returns its samples."""
        # One telephone call reads all that is due at a time.
        samples = poll.read(units, now, time, None if self.reaches_by_modem else self._phases)
        if poll.block.every > LONG:
            self._hasten(poll, now)
        self._queue.push(poll)
        return samples

    def polled(self, poll: PollEntry, now: float, *, answered: bool = True) -> None:
        """Ends the poll for this period, after a reply without values, or none."""
        poll.ended(now, answered, None if self.reaches_by_modem else self._phases)
        if poll.block.every > LONG:
            self._hasten(poll, now)
        self._queue.push(poll)

    def again(self, poll: PollEntry, when: float | None = None, *, counted: bool = True) -> None:
        """Polls again when the deadline is the earliest, or from `when` on."""
        poll.try_again(when, counted=counted)
        self._queue.push(poll)

    def failed(self, now: float, took: float) -> None:
        """Notes an unclear transaction of `took` seconds with a device that is not offline."""
        self._probes.failed(now, took)

    def went_offline(self, device: Device, now: float, took: float) -> None:
        """Makes the device offline, after a failed probe or last retry of `took` seconds."""
        self._probes.went_offline(device, now, took)

    def resynced(self, device: Device) -> None:
        """Compares the next read of each block with nothing: it decodes all units."""
        for poll in self._polls[device]:
            poll.reads.compare_with_nothing()

    def came_online(self, device: Device, now: float) -> None:
        """Makes all blocks of a device due, because it came online. Others may be back, too."""
        for other in self.devices:
            if other.health.state is State.OFFLINE:
                other.health.probes.soon()
        for poll in self._polls[device]:
            poll.came_online(now)
        self.plan(device, now)
        polls, bad = self._polls[device], device.bad_addresses
        for poll in polls:
            poll.spread()
        # What the device is silent about would end it again, before anything is read.
        sound = [poll for poll in polls if not bad.has_failed(poll.block.span)]
        if sound and len(sound) < len(polls):
            self.expedite(sound[0])

    def opened(self, now: float) -> None:
        """Starts again after the line was opened."""
        self._probes.opened(now)
        self.unanswered.requests.clear()
        self._wrote = self._expedited = False
