"""Applies the result of a transaction to device health, schedule and samples."""

import math
from collections.abc import Sequence
from typing import Any

from gateway.engine.device import Device
from gateway.engine.effects import Effects, Samples
from gateway.engine.health import State
from gateway.engine.jobs import Poll
from gateway.engine.schedule import Schedule
from gateway.engine.staleness import Staleness
from gateway.errors import (
    DeviceError,
    Garbled,
    GatewayError,
    Offline,
    Refusal,
    Refused,
    Unsteady,
)
from gateway.planning.planner import describe
from gateway.protocols.driver import Span
from gateway.tags import Reason, Sample
from gateway.tags.unchanged import Unchanged

BUSY_PAUSE = 0.2  # seconds of pause for a busy device, doubled each time


class Results:
    """The rules for results of polls and probes, and for every unclear end."""

    def __init__(
        self, line: str, schedule: Schedule, staleness: Staleness, effects: Effects
    ) -> None:
        self._line = line
        self._schedule = schedule
        self._staleness = staleness
        self._effects = effects

    # Replies

    def answered(self, device: Device, now: float, time: int) -> None:
        """Notes a reply of the device, also an error reply."""
        health = device.health
        if health.state is State.ONLINE and not health.needs_resync:
            return
        if health.answered():
            self._effects.online(device, True)
            self._effects.info("device online", line=self._line, device=device.name)
            device.bad_addresses.abandon()
            self._schedule.came_online(device, now)
            self._staleness.look(now, time)

    def read(self, poll: Poll, units: Sequence[int], now: float, time: int) -> None:
        """Applies a good read of a block."""
        device, block = poll.device, poll.block
        health, last = device.health, poll.last
        if health.needs_resync or health.state is not State.ONLINE:
            self.answered(device, now, time)
        counts = poll.counts
        if last.at is not None:
            gap = now - last.at
            if gap > counts.worst_gap:
                counts.worst_gap = gap
            counts.mean_gap += (gap - counts.mean_gap) / max(1, min(10, counts.reads))
        counts.reads += 1
        last.at, last.ever = now, True
        self._effects.collected.append(Samples(self._samples(poll, units, time)))
        if block.of_fields:
            self._count_garbled(device, units)
        self._schedule.polled(poll, now)
        bad = device.bad_addresses
        if bad.bad or bad.searches:
            if bad.read(block):
                self._effects.info("address returned", device=device.name, block=describe(block))
                self._plan(device, now)
            self._end_search(device, now)
        if device.record.exchanges < device.turnaround.look_at or bad.searching:
            return
        if device.learn_turnaround():
            expected = device.turnaround.expected
            self._effects.info("plan updated", device=device.name, turnaround=expected)
            self._schedule.plan(device, now)

    def _samples(self, poll: Poll, units: Sequence[int], time: int) -> Sequence[Sample]:
        """Returns the samples of the units. Equal units are not decoded again."""
        last = poll.last
        samples = last.samples
        if samples is None or units != last.units or poll.block.eager:
            last.units = units
            last.samples = samples = poll.block.decode(units, time)
        elif not isinstance(samples, Unchanged):
            last.samples = samples = Unchanged(samples, time)
        elif samples.superseded:
            last.samples = samples = poll.block.decode(units, time)
        else:
            samples.time = time
        return samples

    def _count_garbled(self, device: Device, fields: Sequence[Any]) -> None:
        """Counts the garbled fields of a good frame."""
        for value in fields:
            if isinstance(value, Garbled):
                device.record.count_failure(value)
                heard = value.data.hex(" ")
                self._effects.info("field garbled", device=device.name, why=str(value), bytes=heard)

    def unsteady(self, poll: Poll, error: Unsteady, now: float, time: int) -> None:
        """Applies two different reads of a block: polls it again, or turns its tags bad."""
        if poll.tries < poll.device.timing.retries:
            self._schedule.again(poll)
            return
        self._end_badly(poll, Reason.GARBLED, error, now, time)

    def refused(self, poll: Poll, error: Refused, now: float, time: int) -> None:
        """Applies the refusal of a poll: polls again, halves the block, or turns its tags bad."""
        device, block = poll.device, poll.block
        device.record.count_refusal(error)
        if block.listed:
            device.forget_list()
        if error.refusal is Refusal.DAMAGED and poll.tries < device.timing.retries:
            self._schedule.again(poll)
            return
        if error.refusal is Refusal.BUSY and poll.tries < device.timing.retries:
            self._schedule.again(poll, now + BUSY_PAUSE * 2**poll.tries)
            return
        if block.listed:
            self._list_refused(poll, error, now)
            return
        if error.refusal is Refusal.ADDRESS and poll.last.ever and not poll.tries:
            self._schedule.again(poll)  # the address was good before: noise can change a request
            return
        if error.refusal is Refusal.ADDRESS:
            known = block.span in device.bad_addresses.bad
            halves = device.bad_addresses.refused(block, time, error.code)
            if halves:
                self._schedule.replace(poll, halves, now)
                return
            log = self._effects.debug if known else self._effects.warning
            log("address refused", device=device.name, block=describe(block), why=str(error))
        self._end_badly(poll, Reason.REFUSED, error, now, time)
        self._end_search(device, now)

    def _list_refused(self, poll: Poll, error: Refused, now: float) -> None:
        """Registers the monitor list again, or plans without one: it may have a bad address."""
        if poll.tries < 1:
            self._schedule.again(poll)
            return
        device = poll.device
        self._effects.warning("monitor list refused", device=device.name, why=str(error))
        device.allow_lists(False)
        self._plan(device, now)

    def _end_badly(
        self, poll: Poll, reason: Reason, error: GatewayError, now: float, time: int
    ) -> None:
        """Turns the tags of a block bad, after a reply without values."""
        poll.forget(now)
        self._effects.bad(poll.block.tags, reason, time, str(error))
        self._schedule.polled(poll, now)

    def _end_search(self, device: Device, now: float) -> None:
        if device.bad_addresses.settle():
            device.allow_lists(True)  # the bad address in the list may be known now
            self._plan(device, now)

    def _plan(self, device: Device, now: float) -> None:
        device.bad_addresses.abandon()
        device.plan()
        self._schedule.plan(device, now)

    # Unclear ends

    def unclear(
        self, device: Device, error: DeviceError, asked: Span | None, now: float, time: int
    ) -> State:
        """Applies an unclear transaction. Returns the state of the device before it."""
        before = device.health.state
        device.health.unclear(error, asked, now)
        device.record.count_failure(error)
        device.forget_list()  # the device may have restarted
        name, why = device.name, str(error)
        if before is State.OFFLINE:  # its probes fail every few seconds
            self._effects.debug("transaction failed", line=self._line, device=name, why=why)
            return before
        self._effects.info("transaction failed", line=self._line, device=name, why=why)
        self._staleness.look(now, time)
        return before

    def settled(
        self,
        device: Device,
        before: State,
        took: float,
        late: float | None,
        now: float,
        time: int,
        *,
        short: bool = False,
    ) -> None:
        """Applies an unclear transaction after the line has settled; it took `took` seconds.

        `late`: seconds from the time-out to the late reply, if it arrived. `short`: it was a short
        probe. A device that starts is offline only after a patient one, unless it was before.
        """
        health = device.health
        if late is not None:
            device.record.count_late()
            timeout = device.timing.reply_timeout
            last = self.outstanding_requests(device) <= 1
            health.replied_late(timeout + late, timeout, last=last)
        if before is not State.OFFLINE:
            self._schedule.failed(now, took)
        unknown = before in (State.STARTING, State.OFFLINE)
        if not unknown and health.consecutive_failures <= device.timing.retries:
            return
        if short and before is State.STARTING and health.heard is not False:
            return
        if device.broadcast:  # only its own frames can make it online again
            device.restart()
            if not unknown:
                self._effects.online(device, False)
            return
        self._schedule.went_offline(device, now, took)
        why = device.diagnosis()
        if not (short and before is State.OFFLINE):  # the values are bad already
            self._effects.bad(device.polled_tags, health.reason, time, why)
        if before is not State.OFFLINE:
            self._effects.online(device, False)
            self._effects.warning("device offline", device=device.name, why=why)
        for request in self._schedule.requests.withdraw(device):
            self._effects.ended(request, offline(device))

    def unread(self, poll: Poll, error: GatewayError, now: float, time: int) -> None:
        """Applies an unclear poll: polls again, or turns its tags bad."""
        device = poll.device
        if device.health.state is State.OFFLINE:
            return
        if poll.tries < device.timing.retries and not poll.missed:
            self._schedule.again(poll)
            return
        poll.forget(now)
        self._effects.bad(poll.block.tags, device.health.reason, time, str(error))
        self._schedule.polled(poll, now, answered=False)

    def outstanding_requests(self, device: Device) -> int:
        """Counts the requests to the device whose reply may still arrive.

        A good read on this line shows that older requests are no longer delayed.
        """
        schedule = self._schedule
        polls = (poll for each in schedule.devices for poll in schedule.polls(each))
        flowed = max((at for poll in polls if (at := poll.last.at) is not None), default=-math.inf)
        return device.health.outstanding_requests(flowed - device.longest_reply)


def offline(device: Device) -> Offline:
    """Returns the outcome of a request that is not sent."""
    return Offline(f"{device.name} does not answer; nothing was sent")
