"""The one shape of the rules of a line."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import (
    Answer,
    Identify,
    Idle,
    Job,
    Poll,
    Reopen,
    Result,
    Traffic,
    Transacted,
)

NEVER = float("inf")


class Rule(Protocol):
    """One rule of a line. It has those of these methods that it needs; the others cost nothing.

    `now` is the line's clock in seconds, `time` is in nanoseconds since 1970.
    """

    # False: it has nothing to say of polls while the last job of each device ended well.
    always: bool = True

    # False: `before` has nothing to do at present.
    prepares: bool = True

    # May this be sent now, or when?

    def applies(self, devices: Sequence[Device]) -> bool:
        """False if it has nothing to say about these devices: then it is asked nothing else."""
        return True

    def first(self, now: float) -> Answer | Identify | Idle | Reopen | None:
        """Returns a job that precedes all others."""
        return None

    def wake(self, now: float) -> float:
        """Returns when `first` must be asked again, although the line has nothing to do."""
        return NEVER

    def free(self, device: Device, now: float) -> float:
        """Returns the time from which on the device may be polled; at most `now`: at once.

        Requests of clients are not held: their outcome is the answer.
        """
        return now

    def beside(self, poll: Poll, now: float) -> int:
        """Returns how many other polls of the device may share the transaction of this one."""
        return poll.device.window - 1

    def before(self, job: Job, now: float) -> None:
        """Prepares a job that is performed next. Without `always` it is not called for polls."""
        return

    # What follows from this result, or from what was heard?

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Takes the result of a job, before the health of its device changes."""
        return

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes that arrived outside of a transaction."""
        return

    def unmatched(self, device: Device, frame: Any, now: float, time: int, *, echo: bool) -> None:
        """Takes a frame that arrived in a transaction with this device and is not its reply.

        `echo`: it is equal to the request.
        """
        return

    def opened(self, now: float) -> None:
        """Starts again, because the port was opened."""
        return

    def closed(self) -> None:
        """Stops, because the port was lost, or the gateway stops."""
        return

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Takes over changed devices of the line, which are in its list already."""
        return

    # When must it be asked again?

    @property
    def due(self) -> float:
        """The time at which `tick` must be called."""
        return NEVER

    def tick(self, now: float, time: int) -> None:
        """Does what is due."""
        return


_Concluded = Callable[[Transacted, Result, Traffic, float, int], None]


class Rules:
    """The rules of one line, by the methods that they have."""

    def __init__(self, rules: Iterable[Rule], devices: Sequence[Device]) -> None:
        self.all = tuple(rules)
        self._devices = devices
        self.troubled: set[Device] = set()  # whose last job did not end well
        self.select()

    def select(self) -> None:
        """Keeps the rules that apply to the devices of the line."""
        using = [rule for rule in self.all if rule.applies(self._devices)]
        self.first = [rule.first for rule in using if _has(rule, Rule.first)]
        self.wake = [rule.wake for rule in using if _has(rule, Rule.wake)]
        self.free = [rule.free for rule in using if _has(rule, Rule.free)]
        self.beside = [rule.beside for rule in using if _has(rule, Rule.beside)]
        self.preparing = [rule for rule in using if _has(rule, Rule.before)]
        self.preparing_polls = [rule for rule in self.preparing if rule.always]
        self.concluded = [rule.concluded for rule in using if _has(rule, Rule.concluded)]
        always = [rule for rule in using if rule.always]
        self.asked_always = any(_has(rule, Rule.free) or _has(rule, Rule.first) for rule in always)
        self.read = [rule.concluded for rule in always if _has(rule, Rule.concluded)]
        self.received = [rule.received for rule in using if _has(rule, Rule.received)]
        self.unmatched = [rule.unmatched for rule in using if _has(rule, Rule.unmatched)]
        self.timed = [rule for rule in using if type(rule).due is not Rule.due]

    def after(self, device: Device, *, good: bool) -> Sequence[_Concluded]:
        """Returns the rules that take a result of the device, unless all have been good."""
        (self.troubled.discard if good else self.troubled.add)(device)
        return self.concluded

    def preceding(self, now: float) -> Answer | Identify | Idle | Reopen | None:
        """Returns the job that precedes all others, if any."""
        for first in self.first:
            if (job := first(now)) is not None:
                return job
        return None

    def opened(self, now: float) -> None:
        for rule in self.all:
            rule.opened(now)

    def closed(self) -> None:
        for rule in self.all:
            rule.closed()

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        for rule in self.all:
            rule.change(changes, now, is_open=is_open)
        changes.exchange(self.troubled)
        self.select()

    def free_at(self, device: Device, now: float) -> float:
        """Returns the time from which on the device may be polled."""
        return max([free(device, now) for free in self.free], default=now)


def _has(rule: Rule, method: Callable[..., object]) -> bool:
    """Returns True if the rule has its own method in place of this one."""
    return getattr(type(rule), method.__name__) is not method
