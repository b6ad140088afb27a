"""Applies replies and unclear ends of transactions to device health and schedule."""

import math

from gateway.engine.device.device import ANSWERS_TWICE, Device
from gateway.engine.device.health import Heard, State
from gateway.engine.device.reply_shapes import WARY_FOR
from gateway.engine.effects import Effects
from gateway.engine.results.staleness import Staleness
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.probes import is_noisy
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import DeviceError, Offline, log_fields
from gateway.protocols.driver import Span
from gateway.tags import Reason


class HealthRules:
    """The rules for every reply and every unclear end, of polls, probes and requests."""

    def __init__(
        self,
        line: str,
        schedule: Schedule,
        in_flight: InFlight,
        staleness: Staleness,
        effects: Effects,
    ) -> None:
        self._line = line
        self._schedule = schedule
        self._in_flight = in_flight
        self._staleness = staleness
        self._effects = effects

    def answered(self, device: Device, now: float, time: int, *, resynced: bool = False) -> None:
        """Notes a reply of the device, also an error reply. `resynced`: to a resync."""
        health = device.health
        if resynced:
            self._schedule.resynced(device)
            if device.shapes is not None:
                device.shapes.marked(now)
        if health.state is State.ONLINE and not health.needs_resync:
            return
        if health.answered(resynced=resynced):
            device.record.falls.rise(now)
            if device.shapes is not None:
                device.shapes.longer.restart(now)
            self._effects.online(device, True)
            self._effects.info("device online", line=self._line, device=device.name)
            device.bad_addresses.abandon()
            self._schedule.came_online(device, now)
            self._staleness.tick(now, time)

    def unclear(
        self,
        device: Device,
        error: DeviceError,
        asked: Span | None,
        now: float,
        time: int,
        *,
        known: bool = False,
        resynced: bool = False,
    ) -> State:
        """Applies an unclear transaction. Returns the state of the device before it."""
        before = device.health.state
        device.health.unclear(error, asked, now, known=known, resynced=resynced)
        device.record.count_failure(error)
        device.monitor.forget()  # the device may have restarted
        # The probes of an offline device fail every few seconds.
        log = self._effects.debug if before is State.OFFLINE else self._effects.info
        log("transaction failed", line=self._line, device=device.name, **log_fields(error))
        if before is State.OFFLINE:
            return before
        self._staleness.tick(now, time)
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
        suspect: int = 0,
    ) -> None:
        """Applies an unclear transaction after the line has settled; it took `took` seconds.

        `late`: seconds from the time-out to the late reply, if it arrived. `short`: it was a short
        probe. A device that starts is offline only after a patient one, unless it was before.
        `suspect`: failures in a row that an address may explain about which the device is silent.
        The device is offline only if it does not reply to the next request either, also with
        `retries: 0`. The same is true if it answered another request in this time: it may take one
        at a time.
        """
        health = device.health
        if late is not None:
            device.record.count_late()
            timeout = device.timing.reply_timeout
            # A bridge may say late that one address is silent: a resync shows if the device is.
            last = self.outstanding_requests(device) <= 1 and device.shapes is not None
            health.replied_late(timeout + late, timeout, now, last=last)
        if before is not State.OFFLINE:
            self._schedule.failed(now, took)
        unknown = before in (State.STARTING, State.OFFLINE)
        reads = (poll.reads.at for poll in self._schedule.polls(device))
        suspect = suspect or int(any(at is not None and at > now - took for at in reads))
        retries = max(device.timing.retries, suspect)
        if not unknown and health.consecutive_failures <= retries:
            return
        if short and before is State.STARTING and health.heard is not Heard.GAVE_UP:
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
            device.record.falls.fall(now)
            self._effects.online(device, False)
            self._effects.warning("device offline", device=device.name, why=why)
        for request in self._schedule.requests.withdraw(device):
            self._effects.unsent(request, offline(device))

    def is_noisy(self, device: Device, now: float) -> bool:
        """Returns True if replies of the device are damaged on the way."""
        return is_noisy(device, self._schedule.devices, now)

    def spoke(self, device: Device, now: float) -> None:
        """Applies a sound frame of a device, which no request waits for."""
        alone = not any(other.health.online for other in self._schedule.devices)
        device.health.spoke(now, device.longest_reply, alone=alone)

    def answered_twice(self, device: Device, now: float, time: int) -> None:
        """Applies a reply to no request: values read just before may be those of other tags.

        They turn bad and are read again after a resync. Values that were read before the wire was
        quiet stay good: an extra reply would have arrived then.
        """
        health, shapes = device.health, device.shapes
        if shapes is None:
            return
        if not self._in_flight.doubts(device) and (health.needs_resync or not health.online):
            return  # the reply to an older request, which the resync expects
        known, why = shapes.answers_twice, ANSWERS_TWICE.format(station=device.driver.station)
        suspect = now - shapes.at < shapes.quiet
        for other in self._schedule.devices:
            if other.shapes is not None:
                other.shapes.doubt(now)
        shapes.extra_arrived(now)
        health.answered_twice(shapes.span, now)
        log = self._effects.debug if known else self._effects.warning
        log("device answers twice", line=self._line, device=device.name, why=why)
        for poll in self._schedule.polls(device):
            at = poll.reads.at
            if suspect and at is not None and at >= shapes.proven:
                poll.forget(now)
                self._effects.bad(poll.block.tags, Reason.GARBLED, time, why)
                self._schedule.expedite(poll)
        if any(block.listed for block in device.blocks):  # replies to one list are all alike
            device.monitor.forbid(now + WARY_FOR)
            device.plan()
            self._schedule.plan(device, now)

    def outstanding_requests(self, device: Device) -> int:
        """Counts the requests to the device whose reply may still arrive.

        A good read of this device shows that older requests are no longer delayed. Reads of other
        devices do not: each may have a link of its own behind one port.
        """
        polls = self._schedule.polls(device)
        flowed = max((at for poll in polls if (at := poll.reads.at) is not None), default=-math.inf)
        return device.health.outstanding_requests(flowed - device.longest_reply)


def offline(device: Device) -> Offline:
    """Returns the outcome of a request that is not sent."""
    return Offline(f"{device.name} does not answer; nothing was sent")
