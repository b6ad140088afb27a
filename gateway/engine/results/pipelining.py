"""Requests together: finds devices that take one request at a time, although `window` is larger."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import Poll, Probe, Result, Traffic, Transacted
from gateway.engine.results.rule import Rule
from gateway.engine.schedule.in_flight import InFlight
from gateway.errors import Unclear, Unsteady
from gateway.protocols.driver import Span

PROOFS = 3  # requests that were answered alone and not beside others
LOST = "requests that are sent together stay unanswered: now one at a time; set window: 1"
ALONE = 10.0  # seconds at most in which all polls go alone, until the suspects had theirs
TRY_AGAIN = 3600.0  # seconds; a device may have been busy


@dataclass(slots=True)
class _Window:
    """The evidence of one device."""

    suspects: set[Span] = field(default_factory=set)  # unanswered beside others, not yet alone
    alone_until: float = 0.0
    proofs: int = 0
    apart_until: float = 0.0

    def ended(self, failed: set[Span], now: float) -> None:
        """Takes the end of a transaction of several polls. Another plan has other polls."""
        self.suspects, self.alone_until = failed, now + ALONE
        if not failed:
            self.proofs = 0

    def probed(self, now: float) -> None:
        """Gives the suspects their time: none was polled while the device was offline."""
        if self.suspects:
            self.alone_until = now + ALONE

    def proved(self) -> None:
        """Counts a suspect that was answered alone."""
        self.suspects = set()
        self.proofs += 1

    def stay_apart(self, until: float) -> None:
        self.apart_until = until


class Pipelining(Rule):
    """Decides how many polls of a device share a transaction.

    A poll without a reply beside others is polled alone. A reply then proves that the device lost
    the request because of the others. A transaction in which all are answered proves the opposite.
    Until then no other polls share a transaction: one more loss may take the device offline.
    """

    def __init__(self, in_flight: InFlight, effects: Effects) -> None:
        self._in_flight = in_flight
        self._effects = effects
        self._failed: list[Poll] = []  # of the present transaction
        self._ended_polls = 0  # of it
        self._windows: dict[Device, _Window] = {}

    def applies(self, devices: Sequence[Device]) -> bool:
        return any(device.window > 1 for device in devices)

    def opened(self, now: float) -> None:
        self._failed.clear()
        self._ended_polls = 0

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        changes.carry(self._windows)

    def beside(self, poll: Poll, now: float) -> int:
        """Returns how many polls may be sent beside this one."""
        window = self._windows.get(poll.device)
        if window is not None:
            suspects = window.suspects
            if now < window.apart_until or poll.block.span in suspects:
                return 0
            if now < window.alone_until and suspects - poll.device.bad_addresses.bad.keys():
                return 0
        return poll.device.window - 1

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Takes the results of the polls of a transaction, until the last one has ended."""
        if isinstance(job, Probe) and job.device in self._windows:
            self._windows[job.device].probed(now)
        if not isinstance(job, Poll) or job.device.window == 1:
            return
        self._ended_polls += 1
        if isinstance(result, Unclear) and not isinstance(result, Unsteady):
            self._failed.append(job)
        if len(self._in_flight.open) == 1:
            failed, self._failed = self._failed, []
            count, self._ended_polls = self._ended_polls, 0
            self._ended(job, count, failed, now)

    def _ended(self, poll: Poll, count: int, failed: Sequence[Poll], now: float) -> None:
        """Takes the end of a transaction with `count` polls, of which `poll` was the last."""
        device = poll.device
        window = self._windows.get(device)
        if window is None:
            window = self._windows[device] = _Window()
        if count > 1:
            window.ended({each.block.span for each in failed}, now)
            if not failed:
                device.takes_one_at_a_time(False)
        elif poll.block.span in window.suspects:
            window.suspects.remove(poll.block.span)
            if not failed:
                window.proved()
                self._judge(device, window, now)

    def _judge(self, device: Device, window: _Window, now: float) -> None:
        if window.proofs < PROOFS and not device.one_at_a_time:
            return
        window.stay_apart(now + TRY_AGAIN)
        if not device.one_at_a_time:
            device.takes_one_at_a_time(True)
            self._effects.warning("window reduced", device=device.name, why=LOST)
