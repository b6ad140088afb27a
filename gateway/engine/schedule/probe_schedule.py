"""Decides which device of a line is probed next, and how long the probe waits."""

import random
from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.probe_pace import PROBE_SPREAD
from gateway.engine.jobs.jobs import Probe
from gateway.engine.schedule.probes import (
    PATIENT_AFTER,
    brief_timeout,
    is_noisy,
    offline_share,
    order_of_start,
    probe_seconds,
    short_timeout,
)

NEVER = float("inf")


class ProbeSchedule:
    """The probes of one line, and their shares of the wire's time."""

    def __init__(self, devices: Sequence[Device], now: float, seed: int) -> None:
        self.failing_lane = now  # the time of the next request that may fail, while polls are due
        self._devices = devices
        self._random = random.Random(seed)  # noqa: S311  (jitter, not a secret)
        self._offline_lane = now  # the time of the next probe of an offline device beside idle time
        self._in_idle_time = False  # the current probe uses idle time of the wire

    def opened(self, now: float) -> None:
        """Starts again after the line was opened."""
        self.failing_lane = self._offline_lane = now

    def reachable(self, device: Device, now: float, *, late: bool) -> bool:
        """Returns True if the offline device is probed at once for a request.

        `late`: polls of others are late.
        """
        if not self._any_online:
            return True
        idle = not (device.driver.traits.over_network or late)
        return device.health.probes.may_be_sent(now) and (idle or self._offline_lane <= now)

    def for_request(self, device: Device, now: float, *, due: bool) -> Probe | None:
        """Returns the probe before a request to the device, which needs a resync.

        `due`: a poll is due.
        """
        offline = device.health.state is State.OFFLINE
        lane = self._offline_lane if offline else self.failing_lane
        if lane > now and (due or not offline):
            return None
        self._in_idle_time = not due
        return self.probe(device, now)

    def next(self, others: Sequence[Device], now: float, idle_until: float) -> Probe | float:
        """Returns the probe of a starting or an offline device, or the time of the next one.

        `idle_until`: when the next poll is due; `now` while one is due.
        """
        until, idle = NEVER, idle_until > now
        starting = [
            device
            for device in others
            if device.health.state is State.STARTING and device.health.needs_resync
        ]
        if starting:
            if idle or self.failing_lane <= now:
                return self.probe(min(starting, key=order_of_start), now)
            until = self.failing_lane
        offline = [device for device in others if device.health.state is State.OFFLINE]
        if not offline:
            return until
        for device in sorted(offline, key=lambda device: device.health.probes.due):
            if device.health.probes.due > now:
                until = min(until, device.health.probes.due)
                break
            # A long probe that waits for its share must not hold up a short one that fits.
            if (probe := self._offline(device, now, idle_until)) is not None:
                return probe
            until = min(until, self._offline_lane)
        return until

    def _offline(self, device: Device, now: float, idle_until: float) -> Probe | None:
        """Returns the probe that the wire has time for, if any."""
        health, urgent = device.health, device.health.probes.is_urgent(now)
        if urgent:  # its damaged replies show that the wire is the trouble
            return self.probe(device, now) if idle_until > now or self.failing_lane <= now else None
        if health.probes.is_back:
            return self.probe(device, now, patient=True)
        if idle_until <= now < self._offline_lane:
            return None
        short = short_timeout(device, self._devices)
        if short is None or health.probes.patient or health.probes.short >= PATIENT_AFTER:
            fits = idle_until - now >= probe_seconds(device)
            self._in_idle_time = fits and not device.driver.traits.over_network
            if self._in_idle_time or self._offline_lane <= now:
                return self.probe(device, now, patient=True)
        if short is None:
            return None
        room = idle_until - now
        if room > 0.0:  # no poll is due
            room = max(room, *(device.longest_poll for device in self._devices))
        self._in_idle_time = room >= probe_seconds(device, short)
        return self.probe(device, now) if self._in_idle_time or self._offline_lane <= now else None

    def probe(self, device: Device, now: float, *, patient: bool = False) -> Probe:
        """Returns a probe. It is short if the device is offline, or starts, or if noise destroys
        its replies: one that has not come by then does not come."""
        health, timeout, brief = device.health, None, None
        starting = health.state is State.STARTING and not health.probes.short
        if is_noisy(device, self._devices, now) and health.probes.short < PATIENT_AFTER:
            timeout = brief_timeout(device)
        elif not patient and (starting or health.state is State.OFFLINE):
            timeout = short_timeout(device, self._devices)
        elif health.state is State.OFFLINE and not health.probes.patient:
            brief = short_timeout(device, self._devices)
        health.probes.sent(short=timeout is not None)
        token = health.next_probe_token()
        return Probe(device, health.outstanding, token, timeout=timeout, brief=brief)

    def failed(self, now: float, took: float) -> None:
        """Notes an unclear transaction of `took` seconds with a device that is not offline."""
        self.failing_lane = now + took
        self._in_idle_time = False

    def went_offline(self, device: Device, now: float, took: float) -> None:
        """Makes the device offline, after a failed probe or last retry of `took` seconds."""
        device.health.gave_up(now, self._random.uniform(1 - PROBE_SPREAD, 1 + PROBE_SPREAD))
        if device.health.probes.is_urgent(now):
            self.failing_lane = now + took
            return
        if self._in_idle_time:
            return
        # Several polls were lost, or the process stood still.
        took = min(took, probe_seconds(device) + device.longest_reply)
        silent = [other.health.state for other in self._devices].count(State.OFFLINE)
        share = offline_share(silent, over_network=device.driver.traits.over_network)
        self._offline_lane = now + took * (1 / share - 1) if self._any_online else now

    @property
    def _any_online(self) -> bool:
        return any(device.health.online for device in self._devices)
