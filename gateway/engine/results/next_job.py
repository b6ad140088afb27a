"""Applies the result of a job that is no good read, and decides what follows it."""

from gateway.engine.device.health import State
from gateway.engine.device.second_requests import is_like_a_second, leave_second, second_token
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    Identified,
    Identify,
    Poll,
    Probe,
    ReadBack,
    Repeat,
    RequestJob,
    Result,
    Resynced,
    Settle,
    Settled,
    Traffic,
    Transacted,
    Unfinished,
    WriteTogether,
    may_be_told,
    span_of,
)
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.jobs.requests import Command, Write
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.poll_rules import PollRules
from gateway.engine.results.proofs import Proofs
from gateway.engine.results.request_rules import RequestRules
from gateway.engine.schedule.in_flight import InFlight
from gateway.errors import (
    BadValue,
    DeviceError,
    Garbled,
    LineDown,
    NoReply,
    Refused,
    RefusedOther,
    Unclear,
    Unsteady,
)
from gateway.protocols.driver import EVERY_REQUEST, PROOF

NEVER_QUIET = "the line is never quiet, the order of replies is unknown: noise, or another master"


class NextJob:
    """The rules that lead from one job to the next of the same transaction.

    An unclear end is followed by `Settle`, a write whose tag says so by `Confirm` and `Repeat`, a
    probe after many open requests by a second one.
    """

    def __init__(
        self,
        in_flight: InFlight,
        proofs: Proofs,
        results: HealthRules,
        polls: PollRules,
        requests: RequestRules,
        effects: Effects,
        gap: float,
    ) -> None:
        """`gap`: seconds without a byte that end a run of noise."""
        # An earlier process may have left requests in a device server, until the wire was quiet.
        self.inherits = False
        self._in_flight = in_flight
        self.proofs = proofs
        self._results = results
        self._polls = polls
        self._requests = requests
        self._effects = effects
        self._gap = gap

    def inherit(self) -> None:
        """Notes that a device server may have kept requests of an earlier process."""
        self.inherits = True

    def poll_failed(self, poll: PollEntry, result: Result, now: float, time: int) -> None:
        """Applies the result of a poll without units."""
        device, results = poll.device, self._results
        match result:
            case Refused():
                results.answered(device, now, time)
                self._polls.refused(poll, result, now, time)
                self.proofs.refused(device, now)
            case Unsteady():
                results.answered(device, now, time)
                self._polls.unsteady(poll, result, now, time)
                self.proofs.refused(device, now)
            case DeviceError():
                self._in_flight.failed.append((poll, result))
            case LineDown():
                device.health.left_outstanding(poll.job.span, now)
            case Exception():
                raise result

    def polls_ended(self, traffic: Traffic, now: float, time: int) -> None:
        """Applies the end of a transaction of polls, some of which failed."""
        (first, error), *others = self._in_flight.failed
        for poll, _ in others:
            poll.device.health.left_outstanding(poll.job.span, now)
        self.unclear(first.job, error, traffic, now, time)

    def conclude(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Applies the result of a job that is no poll."""
        match job:
            case Settle():
                self._settled(job, result, traffic, now, time)
            case Probe():
                self._probed(job, result, traffic, now, time)
            case Identify():
                self._identified(job, result, traffic, now, time)
            case Answer() if isinstance(result, Garbled):
                self._effects.warning("reply dropped", device=job.device.name, why=str(result))
            case Write() | WriteTogether() | ReadBack() | Command() | Confirm() | Repeat():
                self._requested(job, result, traffic, now, time)

    def _probed(
        self, probe: Probe, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        device = probe.device
        self.proofs.probed(probe, result, traffic, now)
        match result:
            # An error reply counts too, but may belong to an older request.
            case Resynced() | Refused():
                told_from = _told_from(probe, result)
                if outstanding := self._results.outstanding_requests(device):
                    outstanding += device.health.unanswered.either
                inherited = told_from < EVERY_REQUEST and (self.inherits or device.health.inherits)
                if not probe.again and (outstanding > told_from or inherited):
                    if told_from and not inherited and device.may_be_proven(now):
                        self._prove(probe, now)
                        return
                    # A device server may pass on all of them, one after another.
                    quiet = device.longest_reply
                    guard = (outstanding + 1 + inherited) * quiet
                    self._in_flight.follow(Settle(device, guard, quiet, probe))
                else:
                    if probe.again:
                        self.inherits = False
                        device.health.inherit(inherits=False)
                    self._results.answered(device, now, time, resynced=True)
                    self.proofs.resynced(probe, told_from, now, time)
            case Unclear():
                self.unclear(probe, result, traffic, now, time)
            case LineDown():  # its reply may still arrive, on the next connection
                device.health.left_outstanding(None, now)
                _leave_second(probe, now)
            case BadValue():
                raise result

    def _prove(self, probe: Probe, now: float) -> None:
        """Lets a read follow whose reply has a form that no unanswered request has."""
        proof = Probe(probe.device, probe.outstanding, PROOF, timeout=probe.timeout)
        probe.device.note_resync(proof.outstanding, PROOF, now)
        self._in_flight.follow(proof)

    def _identified(
        self, job: Identify, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        match result:
            case Identified() | Refused():
                self._results.answered(job.device, now, time)
            case Unclear():
                self.unclear(job, result, traffic, now, time)
            case LineDown():
                job.device.health.left_outstanding(None, now)

    def _requested(
        self, job: RequestJob, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        match self._requests.conclude(job, result, now, time):
            case Unclear() as error:
                self.unclear(job, error, traffic, now, time)
            case ReadBack() | Repeat() as following:
                self._in_flight.follow(following)

    def unclear(
        self, job: Unfinished, error: DeviceError, traffic: Traffic, now: float, time: int
    ) -> None:
        """Lets the line settle next: the late reply must not disturb another transaction."""
        device = job.device
        self.proofs.release(now, time, proven=False)
        asked, (known, resynced) = span_of(job), may_be_told(job)
        if isinstance(job, Probe):
            _leave_second(job, now)
        before = self._results.unclear(
            device, error, asked, now, time, known=known, resynced=resynced
        )
        no_guard = before is State.OFFLINE or _is_short(job) or self._is_lost(job, error, now)
        settle = Settle(
            device,
            0.0 if no_guard else device.settings.late_guard,
            self._gap,
            after=job,
            error=error,
            before=before,
            sent=traffic.sent > 0,
        )
        self._in_flight.follow(settle)

    def _is_lost(self, job: Unfinished, error: DeviceError, now: float) -> bool:
        """Returns True if noise has likely destroyed the reply: waiting for a late one is no use.

        The resync that follows is safe without the wait: its reply differs. A write keeps the wait,
        for the late reply tells its outcome.
        """
        polled = isinstance(error, NoReply) and isinstance(job, Poll | Probe)
        return polled and job.device.shapes is not None and self._results.is_noisy(job.device, now)

    def _settled(
        self, settle: Settle, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        device, after = settle.device, settle.after
        if settle.error is None:
            if traffic.heard:
                device.health.probes.replied_late(now)
            if isinstance(after, Poll):
                self.proofs.release(now, time, proven=isinstance(result, Settled) and result.quiet)
            elif isinstance(result, Settled) and not result.quiet:
                self.inherits = False  # it is another master that speaks
                device.health.inherit(inherits=False)
                self.unclear(after, Garbled(NEVER_QUIET), Traffic(), now, time)
            elif isinstance(after, Probe):
                self._repeat(after, now)
            return
        short = _is_short(after)
        late = result.late if isinstance(result, Settled) and not short else None
        took = now - self._in_flight.begun
        failed = self._in_flight.failed  # in the same transaction
        alone = len(failed) == 1
        suspect = _suspect(after, settle.error, alone=alone)
        self._results.settled(
            *(device, settle.before, took, late, now, time), short=short, suspect=suspect
        )
        self._polls.fell_silent(settle, now)
        for poll, error in failed:
            self._polls.unread(poll, error, now, time, alone=alone)
        if not isinstance(after, Poll | Probe):
            confirm = self._requests.settled(settle, now)
            if confirm is not None:
                self._in_flight.follow(confirm)
            elif device.health.needs_resync and not isinstance(after, Identify):
                self._in_flight.owe(device)

    def _repeat(self, probe: Probe, now: float) -> None:
        """Lets the second request of a resync follow, or more quiet before it."""
        device, outstanding = probe.device, probe.outstanding
        token, quiet = second_token(device, outstanding, probe.token + 1, now)
        following = Probe(device, outstanding, token, again=True)
        self._in_flight.follow(Settle(device, 2 * quiet, quiet, probe) if quiet else following)

    def abandon(self, error: LineDown | None, now: float) -> None:
        """Ends the job, because the port was lost or the gateway stops."""
        job = self._in_flight.continuation or self._in_flight.job
        if isinstance(job, PollEntry):
            job = job.job
        self._in_flight.clear()
        if job is not None:
            self._requests.abandon(job, error, now)


def _told_from(probe: Probe, result: Resynced | Refused) -> int:
    """Returns the number of unanswered requests from which the reply is told."""
    if isinstance(result, Refused) or is_like_a_second(
        probe.device, probe.outstanding, probe.token
    ):
        return 0
    return result.told_from


def _leave_second(probe: Probe, now: float) -> None:
    """Notes that the second request of a resync has no reply."""
    if probe.again and probe.token != PROOF:
        leave_second(probe.device, probe.outstanding, probe.token, now)


def _suspect(job: Unfinished, error: DeviceError, *, alone: bool) -> int:
    """Returns how many failures in a row a silent address may explain: the poll of a block that
    has it, and a resync near that block. A refusal, whatever it names, is no silence."""
    match job:
        case Poll(block=block):
            longer = job.span is not block.span
            return int(alone and (longer or job.device.bad_addresses.is_suspect(block.span)))
        case Probe(outstanding=outstanding):
            return 2 * job.device.bad_addresses.is_suspect(outstanding)
        case _:
            return int(isinstance(job, Identify) or isinstance(error, RefusedOther))


def _is_short(job: Unfinished) -> bool:
    """Returns True for a probe that waits less than the `reply_timeout` of the device."""
    return isinstance(job, Probe) and job.timeout is not None
