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
from gateway.engine.device.records import LineRecord, Resyncs
from gateway.engine.device.reply_shapes import WARY
from gateway.engine.effects import Effect, Effects
from gateway.engine.jobs.jobs import (
    Answer,
    Identify,
    Idle,
    Job,
    Poll,
    Probe,
    Reopen,
    Result,
    Sent,
    Traffic,
    Transacted,
)
from gateway.engine.jobs.poll_entry import PolledBlock, PollEntry
from gateway.engine.jobs.requests import Request, Write, why_not_commanded
from gateway.engine.jobs.unanswered import Unanswered
from gateway.engine.results.health_rules import HealthRules, offline
from gateway.engine.results.identities import wrong_device
from gateway.engine.results.listening import ONLY_LISTENS, listens
from gateway.engine.results.next_job import NextJob
from gateway.engine.results.poll_rules import PollRules
from gateway.engine.results.proofs import Proofs
from gateway.engine.results.request_rules import RequestRules
from gateway.engine.results.rule import NEVER, Rules
from gateway.engine.results.staleness import Staleness
from gateway.engine.rules import LineState, rules_of
from gateway.engine.schedule.in_flight import MOST_CHARGED, HeldRead, InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import BadValue, Busy, Lent, LineDown, Superseded, Unclear
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
        self._effects = effects = Effects()
        self._in_flight = in_flight = InFlight()
        staleness = Staleness(self.schedule, effects)
        health = HealthRules(name, self.schedule, in_flight, staleness, effects)
        self._polls = PollRules(self.schedule, health, effects)
        self._requests = RequestRules(self.schedule, health, effects)
        gap = max(GAP, 4 * wire.character)
        proofs = Proofs(self.schedule, in_flight, health, self._polls)
        results = health, self._polls, self._requests
        self._next_job = NextJob(in_flight, proofs, *results, effects, gap)
        shared = (self.record, self.schedule, in_flight, staleness, health, effects)
        self.rules = Rules(rules_of(LineState(name, devices, wire, *shared)), devices)
        # Its use of the wire grows: by due polls, and probes; that of the line by requests.
        self._charged: Device | LineRecord | Resyncs | None = None
        self._replies = 0  # of all stations, until the port was opened

    # The cycle of the line

    def next(self, now: float) -> Job:
        """Returns the next job. All except `Idle` and `Reopen` are concluded before the next."""
        job, rules = self._next(now), self.rules
        for rule in rules.preparing_polls if isinstance(job, Poll) else rules.preparing:
            if rule.prepares:
                rule.before(job, now)
        return job

    def _next(self, now: float) -> Job:
        in_flight, rules = self._in_flight, self.rules
        if in_flight.continuation is not None:
            return in_flight.resume(now, self.record)
        if in_flight.job is not None:
            raise AssertionError(f"{in_flight.job!r} is not concluded")
        job: Transacted | PollEntry | Idle | Reopen | None
        if rules.troubled or rules.asked_always:
            job = rules.preceding(now) or self.schedule.next(now, rules.free_at)
        else:
            job = self.schedule.next(now)
        if isinstance(job, PollEntry):
            # A poll on demand is not charged: the device must not lose polls because of it.
            self._charged = None if job.expedited else job.device
            in_flight.open[job.job] = job
            job = job.job
        elif isinstance(job, Idle):
            asked = rules.troubled or rules.asked_always
            wakes = [wake(now) for wake in rules.wake] if asked else ()
            # A rule may have the line wait although another one is due.
            return Idle(min([job.until, *(at for at in wakes if at > now)])) if wakes else job
        elif isinstance(job, Reopen):
            return job
        else:
            others = in_flight.payer(job, self.record) if isinstance(job, Probe) else None
            self._charged = others if isinstance(job, Probe | Answer | Identify) else self.record
            if (shapes := job.device.shapes) is not None:
                if isinstance(job, Probe):
                    shapes.probed(job.outstanding, job.token, job.device.probe_spans, now)
                elif isinstance(job, Answer | Identify):
                    shapes.sent(job.shape if isinstance(job, Identify) else None, now)
        in_flight.job, in_flight.begun = job, now
        return job

    def alongside(self, poll: Poll, now: float) -> Sequence[Poll]:
        """Other due polls of a device that takes several requests at once.

        They share the transaction of `poll`; each is concluded by itself.
        """
        most = min((beside(poll, now) for beside in self.rules.beside), default=0)
        others = self.schedule.alongside(poll.device, most, now)
        self._in_flight.open.update((other.job, other) for other in others)
        return [other.job for other in others]

    def conclude(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> list[Effect]:
        """Applies the result of a job. Polls of one transaction report its traffic once."""
        in_flight = self._in_flight
        if now - in_flight.begun > MOST_CHARGED:
            in_flight.stood_still(now)
        if isinstance(job, Poll):
            good = not isinstance(result, Exception)
            self._note(job, result, traffic, now, time, good=good)
            entry = in_flight.open.pop(job)
            if good:  # units are the only good result of a poll
                units = cast("Sequence[int]", result)
                shapes, doubtful = job.device.shapes, traffic.extra > 0 or traffic.doubtful
                if shapes is not None and (doubtful or in_flight.held or shapes.quiet == WARY):
                    self._next_job.proofs.hold(HeldRead(entry, units, now, time), traffic)
                else:
                    self._polls.read(entry, units, now, time)
            else:
                self._next_job.poll_failed(entry, result, now, time)
            if in_flight.open:
                return self._effects.take()
            if in_flight.failed:
                self._next_job.polls_ended(traffic, now, time)
        else:
            good = self._conclude_other(job, result, traffic, now, time)
        if in_flight.continuation is None:
            in_flight.job = None
            in_flight.failed.clear()
            charged = self._charged
            if charged is not None and (len(self.devices) > 1 or not isinstance(charged, Device)):
                charged.used(now, in_flight.begun)
        effects, self._effects.collected = self._effects.collected, []
        if not good or len(effects) != 1 or self.deadline <= now:
            self._set_deadline()  # a good end alone makes it no earlier
        return effects

    def _conclude_other(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> bool:
        """Applies the result of a job that is no poll. Returns True for a write that is
        acknowledged and tells nothing new."""
        if isinstance(job, Write) and isinstance(result, Sent):
            good = result.acknowledged and not job.masked
            self._note(job, result, traffic, now, time, good=good)
            if good:
                self._requests.written(job, result, now, time)
                return True
        else:
            self._note(job, result, traffic, now, time, good=False)
        self._next_job.conclude(job, result, traffic, now, time)
        return False

    def _note(
        self,
        job: Transacted,
        result: Result,
        traffic: Traffic,
        now: float,
        time: int,
        *,
        good: bool,
    ) -> None:
        """Passes the result to the rules, and counts it. `good`: the job ended well."""
        device, rules = job.device, self.rules
        if traffic.strange or (traffic.heard and isinstance(result, Unclear)):
            for other in self.devices:  # another computer may have registered a list
                other.monitor.forget()
        good = good and not traffic.strange
        if not good or rules.troubled:
            after = rules.after(device, good=good)
        else:
            after = rules.read if isinstance(job, Poll) else ()
        for concluded in after:
            concluded(job, result, traffic, now, time)
        characters = (traffic.sent + traffic.heard) * self.wire.character
        self.record.count(characters, traffic.turnaround)
        own = not (traffic.doubtful and device.is_doubtful) or isinstance(job, Probe)
        exchanges, turnaround = traffic.exchanges, traffic.turnaround
        device.record.count_exchanges(exchanges, characters, turnaround, traffic.ahead, own=own)
        planned = device.turnaround
        slow = turnaround > planned.slow_from or (exchanges and planned.slow)
        if slow and planned.replied(turnaround):
            rules.troubled.add(device)
        if (shapes := device.shapes) is not None:
            shapes.at = now
            if shapes.quiet == WARY and traffic.sent:
                shapes.proofs.twins.replied(traffic.replied, traffic.before)

    @property
    def was_answered(self) -> bool:
        """True if a station replied since the port was opened: it is worth opening at once."""
        return self._count_replies() > self._replies

    def _count_replies(self) -> int:
        return sum(device.record.exchanges + device.record.heard for device in self.devices)

    @property
    def is_idle(self) -> bool:
        """True if no job is in flight. Then bytes that arrive belong to no transaction."""
        return self._in_flight.job is None

    # Requests, bytes and events of the port

    def submit(self, request: Request, now: float) -> list[Effect]:
        """Queues the request, to be sent after the current transaction, or refuses it."""
        queue, device = self.schedule.requests, request.device
        if device.settings.listen_only:
            self._effects.unsent(request, BadValue(ONLY_LISTENS.format(line=self.name)))
            return self._effects.take()
        if isinstance(request, Write):
            for older in queue.superseded(request):
                self._effects.unsent(older, Superseded("a newer value took its place; not sent"))
        elif request.span is None:
            control = device.settings.control
            if why := why_not_commanded(device.driver, request.name, control=control):
                self._effects.unsent(request, BadValue(why))
                return self._effects.take()
        dials = self.schedule.reaches_by_modem  # for a request at once
        if not (self.is_open or dials):
            why = self.record.trouble or f"line {self.name} is not open"
            self._effects.unsent(request, LineDown(why))
        elif not (dials or self.schedule.reachable(device, now)):
            self._effects.unsent(request, offline(device))
        elif not (device.identity is None or device.identity.takes_requests):
            self._effects.unsent(request, wrong_device(device))
        elif not queue.submit(request):
            self._effects.unsent(request, Busy(TOO_MANY.format(line=self.name)))
        self._set_deadline()
        return self._effects.take()

    def probe_timeout(self, waiting: Device) -> float | None:
        """Returns the seconds that a probe in flight may wait from now on, because a request to
        another device waits; None: the job in flight goes on."""
        job = self._in_flight.job
        return job.brief if isinstance(job, Probe) and job.device is not waiting else None

    def submit_group(self, writes: Sequence[Write], now: float) -> list[Effect]:
        """Queues the writes of one group, or refuses them all."""
        if self.schedule.requests.has_room(len(writes)):
            return [effect for write in writes for effect in self.submit(write, now)]
        for write in writes:
            self._effects.unsent(write, Busy(TOO_MANY.format(line=self.name)))
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
        self._in_flight.doubt()  # they may be a part of the own reply to a held read
        if listens(self.devices):
            self.record.count(len(data) * self.wire.character, 0.0)  # of another master
        else:
            self.record.count_unasked(len(data))
        for received in self.rules.received:
            received(data, now, time)
        self._set_deadline()
        return self._effects.take()

    def unmatched(
        self, device: Device, frame: Any, now: float, time: int, *, echo: bool = False
    ) -> list[Effect]:
        """Takes a frame that arrived in a transaction with this device and is not its reply.

        `echo`: it is equal to the request.
        """
        for unmatched in self.rules.unmatched:
            unmatched(device, frame, now, time, echo=echo)
        self._set_deadline()
        return self._effects.take()

    def change(self, changes: Changes, now: float) -> list[Effect]:
        """Takes over changed devices, while `is_idle`. Waiting requests to them are refused."""
        for device in changes.left:
            for request in self.schedule.requests.withdraw(device):
                why = f"the file was reloaded and changed {device.name}; not sent"
                self._effects.unsent(request, Busy(why))
        for device in changes.removed:
            self._effects.online(device, False)
        for old, new in changes.replaced:
            new.take_over(old)
        self.devices[:] = changes.applied(self.devices)
        self.schedule.change(changes, now)
        for device in changes.added:  # its station may be that of a device before
            device.health.inherit()
        self.rules.change(changes, now, is_open=self.is_open)
        self._polls.change(changes)
        self._set_deadline()
        return self._effects.take()

    def expire(self, now: float, time: int) -> list[Effect]:
        """Ends requests that waited too long, and turns old values bad. Called at `deadline`."""
        for rule in self.rules.timed:
            if rule.due <= now:
                rule.tick(now, time)
        self._set_deadline()
        return self._effects.take()

    def inherits(self) -> None:
        """Notes that a device server may have kept requests of an earlier process."""
        self._next_job.inherit()

    def opened(self, now: float, note: str = "") -> list[Effect]:
        """Starts all devices again, because the port was opened. `note`: what is wrong with it."""
        self.is_open = True
        self._replies = self._count_replies()
        self.record.open(now)
        self._in_flight.clear()
        for device in self.devices:
            device.restart(note=note)
        self.schedule.opened(now)
        self.rules.opened(now)
        self._set_deadline()
        return self._effects.take()

    def lost(self, error: LineDown, now: float, time: int) -> list[Effect]:
        """Turns every value bad, because the port was lost or could not be opened."""
        why, lent = str(error), isinstance(error, Lent)
        self._next_job.abandon(error, now)
        self.record.lose(why, now, was_open=self.is_open)
        for device in self.devices:
            device.restart(error)
            self._effects.online(device, False)
            reason = Reason.MAINTENANCE if lent else Reason.LINE_DOWN
            self._effects.bad(device.tags, reason, time, why)
        return self._close(f": {why}")

    def stopped(self, now: float) -> list[Effect]:
        """Ends every request, because the gateway stops."""
        self._next_job.abandon(None, now)
        return self._close()

    def _close(self, why: str = " went down") -> list[Effect]:
        self.is_open = False
        self.rules.closed()
        for request in self.schedule.requests.withdraw():
            self._effects.unsent(request, LineDown(f"line {self.name}{why}; not sent"))
        self._set_deadline()
        return self._effects.take()

    def _set_deadline(self) -> None:
        self.deadline = min([rule.due for rule in self.rules.timed], default=NEVER)
