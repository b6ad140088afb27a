"""No good value outlives its time: what was not read for too long turns bad, whatever the cause."""

import asyncio
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import structlog

from gateway.engine.ages import asked_of, worst_ages
from gateway.engine.device import Device, Standing
from gateway.engine.jobs import Poll
from gateway.engine.schedule import Schedule
from gateway.planning.planner import describe
from gateway.tags import Reason, Tag

log = structlog.get_logger("gateway.line")
TELL_EVERY = 60.0  # seconds for each device
WHY = "others on the line, or writes, take its time"


@dataclass(slots=True)
class Overdue:
    """Looks after the values of one line.

    Those of a device that fails turn bad once they are two intervals old. All others do at twice
    the worst age that `check` promises, and already at once that while some device fails, as the
    whole line may be dead; in either case after the longest that one failure holds up the line.
    """

    schedule: Schedule
    bad: Callable[[Sequence[Tag], Reason, str], None]
    _timer: asyncio.TimerHandle | None = None
    _reckoned: list[tuple[Device, Sequence[Poll], float | None]] = field(default_factory=list)
    _ages: list[float] = field(default_factory=list)
    _told: dict[Device, float] = field(default_factory=dict)

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def watch(self) -> None:
        """Look at every value now, and again when the next may be too old."""
        self.stop()
        loop = asyncio.get_running_loop()
        now, later = loop.time(), float("inf")
        for poll, limit in self._limits():
            if poll.last_good is None:
                later = min(later, now + limit)
            elif poll.last_good + limit > now:
                later = min(later, poll.last_good + limit)
            else:
                self._turn_bad(poll, now)
        if later < float("inf"):
            self._timer = loop.call_at(later, self.watch)

    def _limits(self) -> Iterator[tuple[Poll, float]]:
        """How old the values of each may get. Those of devices not served are bad already."""
        devices = self.schedule.devices
        failing = any(device.standing is Standing.FAILING for device in devices)
        stretch = 1.0 if failing else 2.0
        held_up = max(device.patience for device in devices)
        for poll, age in zip(*self._worst_ages(), strict=True):
            if poll.device.standing is Standing.FAILING:
                yield poll, 2 * poll.block.every
            else:
                yield poll, stretch * age + held_up

    def _worst_ages(self) -> tuple[list[Poll], list[float]]:
        """Reckoned anew where the plan has changed."""
        served = [device for device in self.schedule.devices if device.served]
        plan = [(device, self.schedule.polls(device), device.reckoned) for device in served]
        polls = [poll for _, polls, _ in plan for poll in polls]
        if plan != self._reckoned:
            blocks = [asked_of(poll.device, poll.block) for poll in polls]
            self._reckoned, self._ages = plan, worst_ages(blocks)
        return polls, self._ages

    def _turn_bad(self, poll: Poll, now: float) -> None:
        device, age = poll.device, poll.forget(now)
        if device.standing is Standing.FAILING:
            self.bad(poll.block.tags, device.reason, device.diagnosis())
            return
        device.record.overdue += 1
        self.bad(poll.block.tags, Reason.OVERDUE, f"not read for {age:.1f} s: {WHY}")
        if now - self._told.get(device, float("-inf")) >= TELL_EVERY:
            self._told[device] = now
            block = describe(poll.block)
            log.warning("overdue", device=device.name, block=block, age=round(age, 1), why=WHY)
