"""A device that takes more of the wire than its plan says gives way to those that do not."""

from collections.abc import Sequence
from typing import NamedTuple

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.probe_pace import HOPE_FOR
from gateway.engine.device.turnaround import SMOOTHED
from gateway.engine.jobs.jobs import Idle, Result, Traffic, Transacted
from gateway.engine.results.rule import Rule
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule

SHARE = 0.01  # of the time for which polls of others may be late because of such devices
LONGEST = 60.0  # seconds without a poll, at most: it may be as quick as before
AGAIN = 0.02  # seconds: not sooner is it asked again if the others have time now
GAP = 0.02  # seconds without a byte after which it has ended what it says


class _Worthless(NamedTuple):
    """A device that is online, and has no good value."""

    since: float
    took: float  # the longest of its transactions, smoothed


class GivingWay(Rule):
    """A poll that takes longer than the plan of its device is sent if all polls of the others are
    in time nevertheless, and for a small share of the time if they are not.

    The plan is that of the file, as `check` prints it. A line that is asked for more than it
    carries has no plan that it can keep: there each device gets its share. A device that replies,
    but has had no good value for long, gives way there, too. After it the wire must be quiet: it
    may say more than its reply.
    """

    always = False

    def __init__(self, devices: Sequence[Device], schedule: Schedule, in_flight: InFlight) -> None:
        self._devices = devices
        self._schedule = schedule
        self._in_flight = in_flight
        self._lane = 0.0  # until then no poll of such a device makes others late
        self._worthless: dict[Device, _Worthless] = {}
        self._quiet_at = self._quiet_by = 0.0  # what a device says more has ended, at the latest

    def applies(self, devices: Sequence[Device]) -> bool:
        return len(devices) > 1

    def first(self, now: float) -> Idle | None:
        return Idle(self._quiet_at) if now < self._quiet_at else None

    def free(self, device: Device, now: float) -> float:
        if self._lane <= now or not (took := self.takes(device, now)):
            return now
        late, _ = self._late_by(device, took, now)
        if late <= 0.0:
            return now
        device.turnaround.give_way()
        return min(self._lane, now + max(late, AGAIN))

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        device = job.device
        if device.health.online and not self._has_good(device):
            since, took = self._worthless.get(device, (now, 0.0))
            took = max(now - self._in_flight.begun, took * SMOOTHED)
            self._worthless[device] = _Worthless(since, took)
        elif self._worthless:
            self._worthless.pop(device, None)
        if not self.takes(device, now):
            return
        if not device.is_slow:
            self._quiet_at, self._quiet_by = now + GAP, now + device.settled_after
        late, every = self._late_by(device, 0.0, now)
        if late > 0.0:  # a poll that late leaves a period out
            self._lane = now + min((late + every) / SHARE, LONGEST)

    def received(self, data: bytes, now: float, time: int) -> None:
        if now < self._quiet_at:
            self._quiet_at = min(now + GAP, self._quiet_by)

    def _has_good(self, device: Device) -> bool:
        return any(poll.reads.at is not None for poll in self._schedule.polls(device))

    def takes(self, device: Device, now: float) -> float:
        """Returns the seconds of a poll of the device, if it must give way; 0: it need not."""
        if device.is_slow:
            return device.turnaround.slow
        if device not in self._worthless or self._has_good(device):
            return 0.0
        since, took = self._worthless[device]
        return took if now - since >= HOPE_FOR else 0.0

    def _late_by(self, device: Device, took: float, now: float) -> tuple[float, float]:
        """Returns the seconds by which a poll of another device is late after one that takes so
        long, and its interval."""
        end, work, load = now + took, 0.0, 0.0
        deadline, every = end + LONGEST, 0.0
        for other in self._devices:
            if not other.health.online or self.takes(other, now):
                continue
            proof = other.settled_after if other.is_doubtful else 0.0
            for poll in self._schedule.polls(other):
                seconds = other.seconds(poll.block.cost) * other.settings.verify_reads + proof
                load += seconds / poll.block.every
                if poll.due <= end:
                    work += seconds
                    if poll.deadline < deadline:
                        deadline, every = poll.deadline, poll.block.every
        overloaded = load > 1.0 and device.is_slow
        return 0.0 if overloaded else end + work - deadline, every

    def opened(self, now: float) -> None:
        self._lane = self._quiet_at = now
        self._worthless.clear()

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        self._lane = now
        changes.carry(self._worthless)
