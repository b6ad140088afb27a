"""The engine of one line: decides its next job, and applies the result of each job.

Synchronous and pure: no asyncio, clock, port or log. Times are passed in: `now` in seconds of
the line's clock, `time` in nanoseconds since 1970 for the samples. The line calls `expire` when
`deadline` is reached, then `next`, performs the job and passes the result to `conclude`. All
other entries take requests, bytes and events of the port. Effects are returned as plain data.
"""

from collections.abc import Sequence
from typing import Any, cast

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.records import LineRecord
from gateway.engine.effects import Effect, Effects
from gateway.engine.jobs.jobs import (
    Idle,
    Job,
    Poll,
    PolledBlock,
    Probe,
    Result,
    Traffic,
    Transacted,
    WriteTogether,
    resync_around,
)
from gateway.engine.jobs.requests import Request, Write, why_not_commanded
from gateway.engine.jobs.unanswered import Unanswered
from gateway.engine.results.health_rules import HealthRules, offline
from gateway.engine.results.listening import ONLY_LISTENS, Listening, listens
from gateway.engine.results.next_job import NextJob
from gateway.engine.results.poll_rules import PollRules
from gateway.engine.results.request_rules import RequestRules
from gateway.engine.results.shorter_silences import ShorterSilences
from gateway.engine.results.staleness import NEVER, Staleness
from gateway.engine.results.stray import Stray
from gateway.engine.results.unsolicited import UnsolicitedFrames
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.poll_entry import PollEntry
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import BadValue, Busy, LineDown, Superseded
from gateway.planning.wire_timing import WireTiming
from gateway.tags import Reason, Tag

GAP = 0.02  # seconds without a byte that end a run of noise
TOO_MANY = "line {line}: too many requests are waiting; not sent"


class Engine:
    """The rules of one line, and its state."""

    def __init__(
        self, name: str, devices: Sequence[Device], wire: WireTiming, seed: int = 0
    ) -> None:
        # One list for all parts of the engine: `change` changes it in place.
        self.devices = devices = list(devices)
        self.is_open = False
        self.record = LineRecord()
        self.deadline = NEVER  # when `expire` must be called
        self.schedule = Schedule(devices, 0.0, seed)
        self.name, self.wire = name, wire
        self._effects = Effects()
        self._staleness = Staleness(self.schedule, self._effects)
        results = HealthRules(name, self.schedule, self._staleness, self._effects)
        self._polls = PollRules(self.schedule, results, self._effects)
        self._unsolicited: UnsolicitedFrames | Listening
        if listens(devices):
            self._unsolicited = Listening(devices, wire, results, self._effects)
        else:
            self._unsolicited = UnsolicitedFrames(devices, results, self._effects)
        self._stray = Stray(name, devices, results, self._effects)
        self._in_flight = InFlight()
        gap = max(GAP, 4 * wire.character)
        requests = RequestRules(self.schedule, results, self._effects)
        self._next_job = NextJob(
            *(self._in_flight, results, self._polls, requests),
            *(ShorterSilences(name, devices, self._effects), self._effects, gap),
        )

    # The cycle of the line

    def next(self, now: float) -> Job:
        """Returns the next job. All except `Idle` and `Reopen` are concluded before the next."""
        shorter = self._next_job.shorter
        if shorter.suspects:
            shorter.judge(now)
        job, in_flight = self._next(now), self._in_flight
        if shorter.step:
            shorter.before(job, in_flight.open.get(job) if isinstance(job, Poll) else None)
        return job

    def _next(self, now: float) -> Job:
        in_flight = self._in_flight
        if in_flight.continuation is not None:
            return in_flight.resume(now)
        if in_flight.job is not None:
            raise AssertionError(f"{in_flight.job!r} is not concluded")
        silence = self._next_job.silence
        may_reopen = silence.noted and not self.schedule.reaches_by_modem
        if may_reopen and silence.due <= now and silence.confirmed(self.schedule, self.devices):
            return silence.reopen(now)
        job: Transacted | PollEntry | Idle | None = None
        if self._unsolicited.speakers:
            job = self._unsolicited.next(now)
        if job is None:
            job = self.schedule.next(now)
        if isinstance(job, PollEntry):
            return in_flight.begin_poll(job, now)
        if isinstance(job, Idle):
            return Idle(silence.due) if may_reopen and now < silence.due < job.until else job
        if type(job) is Write and (shared := self.schedule.requests.companions(job)):
            job = WriteTogether(job.device, shared.writes, shared.run)
        if job.device.shapes is not None:
            resync_around(job, job.device.shapes, now)
        in_flight.begin(job, now, job.device if isinstance(job, Probe) else None)
        return job

    def alongside(self, poll: Poll, now: float) -> Sequence[Poll]:
        """Other due polls of a device that takes several requests at once.

        They share the transaction of `poll`; each is concluded by itself.
        """
        most = self._next_job.pipelining.others(poll, now)
        others = self.schedule.alongside(poll.device, most, now)
        return [self._in_flight.begin_beside(other) for other in others]

    def conclude(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> list[Effect]:
        """Applies the result of a job. Polls of one transaction report its traffic once."""
        device, in_flight = job.device, self._in_flight
        self._next_job.shorter.concluded(job, result, traffic, now)
        self._count(device, traffic, now)
        if isinstance(job, Poll):
            entry = in_flight.open.pop(job)
            if isinstance(result, Exception):
                self._next_job.poll_failed(entry, result, now, time)
            else:  # units are the only good result of a poll
                if self._next_job.silence.noted:
                    self._next_job.silence.heard()
                self._polls.read(entry, cast("Sequence[int]", result), now, time)
            if in_flight.open:
                return self._effects.take()
            if in_flight.failed or device.window > 1:
                self._next_job.polls_ended(job, traffic, now, time)
        else:
            self._next_job.conclude(job, result, traffic, now, time)
        if in_flight.continuation is None:
            in_flight.job = None
            in_flight.failed.clear()
            if in_flight.charged is not None and len(self.devices) > 1:
                in_flight.charged.used(now, in_flight.begun)
        if self._unsolicited.speakers:
            self._unsolicited.transaction_ended(device, now, sent=traffic.sent, heard=traffic.heard)
            self._set_deadline()
        elif self._staleness.due < self.deadline or not isinstance(job, Poll):
            self._set_deadline()
        effects, self._effects.collected = self._effects.collected, []
        return effects

    def _count(self, device: Device, traffic: Traffic, now: float) -> None:
        characters = (traffic.sent + traffic.heard) * self.wire.character
        self.record.count(characters, traffic.turnaround)
        device.record.count_exchanges(traffic.exchanges, characters, traffic.turnaround)
        if device.shapes is not None:
            device.shapes.at = now

    @property
    def is_idle(self) -> bool:
        """True if no job is in flight. Then bytes that arrive belong to no transaction."""
        return self._in_flight.job is None

    # Requests, bytes and events of the port

    def submit(self, request: Request, now: float) -> list[Effect]:
        """Queues the request, to be sent after the current transaction, or refuses it."""
        queue, device = self.schedule.requests, request.device
        if device.settings.listen_only:
            self._effects.ended(request, BadValue(ONLY_LISTENS.format(line=self.name)))
            return self._effects.take()
        if isinstance(request, Write):
            for older in queue.superseded(request):
                self._effects.ended(older, Superseded("a newer value took its place; not sent"))
        elif request.span is None:
            control = device.settings.control
            if why := why_not_commanded(device.driver, request.name, control=control):
                self._effects.ended(request, BadValue(why))
                return self._effects.take()
        dials = self.schedule.reaches_by_modem  # for a request at once
        if not (self.is_open or dials):
            why = self.record.trouble or f"line {self.name} is not open"
            self._effects.ended(request, LineDown(why))
        elif not (dials or self.schedule.reachable(device, now)):
            self._effects.ended(request, offline(device))
        elif not queue.submit(request):
            self._effects.ended(request, Busy(TOO_MANY.format(line=self.name)))
        self._set_deadline()
        return self._effects.take()

    def submit_group(self, writes: Sequence[Write], now: float) -> list[Effect]:
        """Queues the writes of one group, or refuses them all."""
        if self.schedule.requests.has_room(len(writes)):
            return [effect for write in writes for effect in self.submit(write, now)]
        for write in writes:
            self._effects.ended(write, Busy(TOO_MANY.format(line=self.name)))
        return self._effects.take()

    def expedite(self, device: Device, tag: Tag) -> None:
        """Polls the tag's block before all other polls, for a read on demand."""
        poll = self.schedule.reader(device, tag)
        if poll is not None:
            self.schedule.expedite(poll, on_demand=True)

    def polls(self, device: Device) -> Sequence[PolledBlock]:
        """Returns the blocks of the device that are polled, and their last reads."""
        return self.schedule.polls(device)

    def reader(self, device: Device, tag: Tag) -> PolledBlock | None:
        """Returns the block that reads this tag of the device; None: its value is unsolicited."""
        return self.schedule.reader(device, tag)

    @property
    def unanswered(self) -> Unanswered:
        """The timed-out requests of the line, whose replies may arrive in other transactions."""
        return self.schedule.unanswered

    def planned(self, now: float) -> None:
        """Takes over the plans that a thread made of all devices."""
        for device in self.devices:
            self.schedule.plan(device, now)

    def reach_by_modem(self, by_modem: bool = True) -> None:
        """Notes if a telephone call is needed for every exchange."""
        self.schedule.reach_by_modem(by_modem)

    def received(self, data: bytes, now: float, time: int) -> list[Effect]:
        """Takes bytes that arrived outside of a transaction."""
        if isinstance(self._unsolicited, Listening):
            self.record.count(len(data) * self.wire.character, 0.0)  # of another master
        else:
            self.record.count_unasked(len(data))
            self._next_job.shorter.disturbed(now)
            self._stray.received(data, now, time)
        if self._unsolicited.speakers:
            self._next_job.silence.heard()
        self._unsolicited.received(data, now, time)
        self._set_deadline()
        return self._effects.take()

    def unmatched(
        self, device: Device, frame: Any, now: float, time: int, *, echo: bool = False
    ) -> list[Effect]:
        """Takes a frame that arrived in a transaction with this device and is not its reply.

        `echo`: it is equal to the request.
        """
        if not echo:
            self._next_job.silence.heard()
            self._next_job.shorter.disturbed(now)
        self._stray.unmatched(device, frame, now, time, echo=echo)
        self._unsolicited.unmatched(device, frame, now, time)
        self._set_deadline()
        return self._effects.take()

    def change(self, changes: Changes, now: float) -> list[Effect]:
        """Takes over changed devices, while `is_idle`. Waiting requests to them are refused."""
        for device in changes.left:
            for request in self.schedule.requests.withdraw(device):
                why = f"the file was reloaded and changed {device.name}; not sent"
                self._effects.ended(request, Busy(why))
        for device in changes.removed:
            self._effects.online(device, False)
        for old, new in changes.replaced:
            new.take_over(old)
        self.devices[:] = changes.applied(self.devices)
        self.schedule.change(changes, now)
        self._staleness.change(changes, now, is_open=self.is_open)
        self._unsolicited.change(changes, now)
        self._stray.change(changes)
        self._next_job.change(changes, now)
        self._polls.change(changes)
        self._set_deadline()
        return self._effects.take()

    def expire(self, now: float, time: int) -> list[Effect]:
        """Ends requests that waited too long, and turns old values bad. Called at `deadline`."""
        for request in self.schedule.requests.expired(now):
            waited = f"waited {now - request.submitted:.1f} s for the line"
            refused = isinstance(request, Write) and request.alone
            sent = "refused together with others, and not sent alone" if refused else "not sent"
            self._effects.ended(request, Busy(f"{waited}; {sent}"))
        if self._staleness.due <= now:
            self._staleness.look(now, time)
        self._unsolicited.tick(now, time)
        self._set_deadline()
        return self._effects.take()

    def inherits(self) -> None:
        """Notes that a device server may have kept requests of an earlier process."""
        self._next_job.inherit()

    def opened(self, now: float) -> list[Effect]:
        """Starts all devices again, because the port was opened."""
        self.is_open = True
        self.record.open(now)
        self._in_flight.clear()
        self._next_job.silence.opened()
        self._next_job.shorter.opened(now)
        for device in self.devices:
            device.restart()
        self.schedule.opened(now)
        self._unsolicited.opened(now)
        self._set_deadline()
        return self._effects.take()

    def lost(self, error: LineDown, now: float, time: int) -> list[Effect]:
        """Turns every value bad, because the port was lost or could not be opened."""
        why = str(error)
        self._next_job.abandon(error, now)
        self.record.lose(why, now, was_open=self.is_open)
        for device in self.devices:
            device.restart(error)
            self._effects.online(device, False)
            self._effects.bad(device.tags, Reason.LINE_DOWN, time, why)
        return self._close(f": {why}")

    def stopped(self, now: float) -> list[Effect]:
        """Ends every request, because the gateway stops."""
        self._next_job.abandon(None, now)
        return self._close()

    def _close(self, why: str = " went down") -> list[Effect]:
        self.is_open = False
        self._staleness.stop()
        for request in self.schedule.requests.withdraw():
            self._effects.ended(request, LineDown(f"line {self.name}{why}; not sent"))
        self._set_deadline()
        return self._effects.take()

    def _set_deadline(self) -> None:
        deadline = self._staleness.due
        for request in self.schedule.requests.waiting:
            deadline = min(deadline, request.expires)
        if self._unsolicited.speakers:
            deadline = min(deadline, self._unsolicited.due)
        self.deadline = deadline
