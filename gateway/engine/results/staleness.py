"""Staleness: a value that was not read for too long turns bad, whatever the cause."""

from collections.abc import Iterator, Sequence

from gateway.engine.device.ages import polled_block, worst_ages
from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.effects import Effects
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.results.rule import NEVER, Rule
from gateway.engine.schedule.schedule import Schedule
from gateway.planning.planner import describe
from gateway.tags import Reason

LOG_EVERY = 60.0  # seconds for each device
CAUSE = "others on the line, or writes, take its time"
WAITS = "the line waits for {device}, which fails"  # the log says so of that device


class Staleness(Rule):
    """Limits the age of the values of one line.

    A value of a failing device turns bad after two intervals. All others turn bad at twice the
    worst age that `check` prints; at once that age while some device fails, as the whole line may
    be dead. In either case the longest wait for one reply is added.
    """

    due = NEVER  # when `tick` must be called again

    def __init__(self, schedule: Schedule, effects: Effects) -> None:
        self._schedule = schedule
        self._effects = effects
        self._plan: list[tuple[Device, Sequence[PollEntry], int | None]] = []
        self._ages: list[float] = []
        self._logged: dict[Device, float] = {}

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Takes over changed devices: values that go on may have shorter limits."""
        for device in changes.left:
            self._logged.pop(device, None)
        if is_open:
            soonest = min((limit for _, limit in self._limits()), default=NEVER)
            self.due = min(self.due, now + soonest)

    def closed(self) -> None:
        """Stops: all values of the line are bad."""
        self.due = NEVER

    def tick(self, now: float, time: int) -> None:
        """Turns values bad that are too old."""
        self.due = NEVER
        for poll, limit in self._limits():
            at = poll.reads.at
            if at is not None and at + limit <= now:
                self._turn_bad(poll, now, time)
                at = None
            self.due = min(self.due, (now if at is None else at) + limit)  # it may be read soon

    def _limits(self) -> Iterator[tuple[PollEntry, float]]:
        """Yields the age limit of each poll of an online device; other values are bad already."""
        devices = self._schedule.devices
        failing = any(device.health.state is State.FAILING for device in devices)
        stretch = 1.0 if failing else 2.0
        longest_reply = max((device.longest_reply for device in devices), default=0.0)
        longest_reply += self._schedule.unanswered.longest
        for poll, age in zip(*self._worst_ages(), strict=True):
            if poll.device.health.state is State.FAILING:
                yield poll, 2 * poll.block.every
            else:
                yield poll, stretch * age + longest_reply

    def _worst_ages(self) -> tuple[list[PollEntry], list[float]]:
        """Returns the polls with their worst ages. They are calculated again only after a new plan,
        or when a turnaround changed by a millisecond: it is measured all the time."""
        online = [device for device in self._schedule.devices if device.health.online]
        plan = [(d, self._schedule.polls(d), d.turnaround.milliseconds) for d in online]
        polls = [poll for _, polls, _ in plan for poll in polls]
        if plan != self._plan:
            blocks = [polled_block(poll.device, poll.block) for poll in polls]
            self._plan, self._ages = plan, worst_ages(blocks)
        return polls, self._ages

    def _turn_bad(self, poll: PollEntry, now: float, time: int) -> None:
        device, age = poll.device, poll.forget(now)
        if device.health.state is State.FAILING:
            self._effects.bad(poll.block.tags, device.health.reason, time, device.diagnosis())
            return
        device.record.count_overdue()
        failing = (one for one in self._schedule.devices if one.health.state is State.FAILING)
        other = next(failing, None)
        cause = CAUSE if other is None else WAITS.format(device=other.name)
        detail = f"not read for {age:.1f} s: {cause}"
        self._effects.bad(poll.block.tags, Reason.OVERDUE, time, detail)
        if other is None and now - self._logged.get(device, -NEVER) >= LOG_EVERY:
            self._logged[device] = now
            block = describe(poll.block)
            self._effects.warning(
                "block overdue", device=device.name, block=block, age=round(age, 1), why=CAUSE
            )
