"""A device that takes more of the wire than before gives way to those that do not."""

from collections.abc import Sequence
from typing import NamedTuple

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.probe_pace import HOPE_FOR
from gateway.engine.device.turnaround import SMOOTHED
from gateway.engine.jobs.jobs import Idle, Poll, Result, Traffic, Transacted
from gateway.engine.jobs.poll_entry import EXPEDITED
from gateway.engine.results.rule import Rule
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule

SHARE = 0.01  # of the time for which polls of others may be late because of such devices
LONGEST = 60.0  # seconds without a poll, at most: it may be as quick as before
AGAIN = 0.02  # seconds: not sooner is it asked again if the others have time now
SEVERAL, MOST = 8, 16  # polls without a good value
GAP = 0.02  # seconds without a byte after which it has ended what it says


class _Worthless(NamedTuple):
    """An online device whose polls hardly bring a good value."""

    since: float
    reads: int  # good ones so far
    score: int  # polls that brought none, less those that others make up for
    took: float  # the longest of its transactions, smoothed


class GivingWay(Rule):
    """A poll that takes longer than planned is sent if all polls of the others are in time
    nevertheless, and for a small share of the time if they are not.

    The plan has the turnaround of the file, or of the first replies. Where the others leave no room
    for it, each gets its share: the line is asked for too much, or all are slow. A device
    that replies, but has had hardly a good value for long, gives way, too. While extra replies
    arrive, the wire must be quiet after it, and after more characters than those of a reply: it may
    say more.
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
        if late <= 0.0 or self._is_asked(device):
            return now
        if device.is_slow:
            device.turnaround.give_way()
        return min(self._lane, now + max(late, AGAIN))

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        device, took = job.device, now - self._in_flight.begun
        if not device.health.online:
            self._worthless.pop(device, None)
        elif isinstance(job, Poll):
            self._polled(device, now)
        if (known := self._worthless.get(device)) is not None:
            longest = max(took, known.took * SMOOTHED)
            self._worthless[device] = known._replace(took=longest)
        takes = self.takes(device, now)
        if traffic.strange or (takes and device.is_doubtful):
            self._quiet_at, self._quiet_by = now + GAP, now + device.settled_after
        if not takes:
            return
        late, every = self._late_by(device, 0.0, now)
        if late > 0.0:  # a poll so late leaves a period out, if it was not late before
            cost = took if late > took else late + every
            self._lane = now + min(cost / SHARE, LONGEST)

    def _polled(self, device: Device, now: float) -> None:
        """Counts a poll as one that brought no value, until the next one shows what it brought."""
        reads = self._good_reads(device)
        since, before, score, took = self._worthless.get(device, (now, reads, 0, 0.0))
        score = min(score + 1, MOST) if reads == before else max(score - SEVERAL, 0)
        self._worthless[device] = _Worthless(since if score else now, reads, score, took)

    def received(self, data: bytes, now: float, time: int) -> None:
        if now < self._quiet_at:
            self._quiet_at = min(now + GAP, self._quiet_by)

    def _is_asked(self, device: Device) -> bool:
        """Returns True if a client waits for one of its polls."""
        return any(poll.ticket <= EXPEDITED for poll in self._schedule.polls(device))

    def _good_reads(self, device: Device) -> int:
        return sum(poll.reads.count for poll in self._schedule.polls(device))

    def takes(self, device: Device, now: float) -> float:
        """Returns the seconds of a poll of the device, if it must give way; 0: it need not."""
        if device.is_slow:
            return device.turnaround.slow
        known = self._worthless.get(device)
        if known is None or known.score < SEVERAL or now - known.since < HOPE_FOR:
            return 0.0
        return known.took if known.reads == self._good_reads(device) else 0.0

    def _late_by(self, device: Device, took: float, now: float) -> tuple[float, float]:
        """Returns the seconds by which a poll of another device is late after one that takes so
        long, and its interval. Where the others leave no room for its plan, none is."""
        end, work, load = now + took, 0.0, device.turnaround.planned_load
        deadline, every = end + LONGEST, 0.0
        for other in self._devices:
            if other is device or not other.health.online or self.takes(other, now):
                continue
            proof = other.settled_after if other.is_doubtful else 0.0
            for poll in self._schedule.polls(other):
                seconds = other.seconds(poll.block.cost) * other.settings.verify_reads
                load += seconds / poll.block.every
                if poll.due <= end:
                    work += seconds + proof
                    if poll.deadline < deadline:
                        deadline, every = poll.deadline, poll.block.every
        return (0.0 if load > 1.0 else end + work - deadline), every

    def opened(self, now: float) -> None:
        self._lane = self._quiet_at = now
        self._worthless.clear()

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        self._lane = now
        changes.carry(self._worthless)
