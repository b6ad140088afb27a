"""Applies the result of a write or command, so that each client gets exactly one outcome."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.reply_shapes import UNPROVEN, WARY
from gateway.engine.effects import Effects, RequestEnded
from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    HeldTogether,
    ReadBack,
    Repeat,
    RequestJob,
    Result,
    Sent,
    Settle,
    Transacted,
    WriteTogether,
    requests_of,
    span_of,
)
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.jobs.requests import (
    RACE,
    Command,
    Group,
    Outcome,
    Request,
    Write,
    after_failed,
    unsent,
)
from gateway.engine.jobs.runs import own_units, verified
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import Busy, DeviceError, GatewayError, LineDown, Refusal, Refused, Unclear
from gateway.protocols.driver import Span
from gateway.tags import WriteResult

BROADCAST_PAUSE = 0.1  # seconds
_SHOWN = 3  # elements of an array that differ
EITHER = "two stations have this number: nothing tells which of them replied"
STOPPED = "the gateway stopped before the acknowledgement arrived; it may be done"


class Differs(Unclear):
    """The write was acknowledged, but the device holds another value."""


class RequestRules:
    """The rules for results of writes and commands.

    After an unclear end, the rule of the tag decides if a write is sent again.
    """

    def __init__(self, schedule: Schedule, results: HealthRules, effects: Effects) -> None:
        self._schedule = schedule
        self._results = results
        self._effects = effects

    def conclude(
        self, job: RequestJob, result: Result, now: float, time: int
    ) -> Unclear | ReadBack | Repeat | None:
        """Returns the next step: settle after an unclear end, read back, or write again."""
        if isinstance(result, Unclear):
            return result
        match job:
            case _ if isinstance(result, LineDown):
                self.abandon(job, result, now)
            case _ if isinstance(result, Busy):
                self._unsent(job, result, now)
            case Confirm():
                return self._confirmed(job, result, now, time)
            case Command():
                self._commanded(job, result, now, time)
            case WriteTogether():
                return self._written_together(job, result, now, time)
            case ReadBack():
                self._read_back(job, result, now, time)
            case Write():
                self._single(job, result, now, time)
            case Repeat(write=write, error=error):
                self._end(write, self._written(write, result, error, now, time), now)
        return None

    def written(self, write: Write, sent: Sent, now: float, time: int) -> None:
        """Applies the result of a write that was sent."""
        self._end(write, self._written(write, sent, None, now, time), now)

    def settled(self, settle: Settle, now: float) -> Confirm | None:
        """Ends the request after an unclear end, or returns the step that the tag allows."""
        job, error = settle.after, settle.error
        if error is None:
            return None
        match job:
            case Write(device=device, tag=tag) if settle.sent:
                if tag.write is not None and (tag.write.verify or tag.write.repeat):
                    return self._confirm(device, (job,), tag.span, error)
            case WriteTogether(device=device, writes=writes, run=Span() as run) if settle.sent:
                if any(verified(write.tag) for write in writes):
                    return self._confirm(device, writes, run, error)
            case ReadBack(error=first) | Confirm(error=first) | Repeat(error=first):
                error = first
        sent = settle.sent or isinstance(job, ReadBack | Confirm | Repeat)
        for request in requests_of(job):
            self._end(request, error if sent else unsent(request, Busy(str(error))), now)
        return None

    def _confirm(
        self, device: Device, writes: Sequence[Write], run: Span, error: DeviceError
    ) -> Confirm:
        health = device.health
        token = health.next_probe_token()
        return Confirm(device, writes, run, error, health.outstanding, token)

    def abandon(self, job: Transacted, why: LineDown | None, now: float) -> None:
        """Ends the requests of a job when the port is lost. `why` None: the gateway stops."""
        after = job.after if isinstance(job, Settle) else job
        if (requests := requests_of(after)) and not isinstance(after, Answer | Settle):
            job.device.health.left_outstanding(span_of(after), now)
        for request in requests:
            what = "the write" if isinstance(request, Write) else "the command"
            unknown = STOPPED if why is None else f"{why}; it is unknown if {what} was done"
            self._end(request, Unclear(unknown), now)

    def _unsent(self, job: RequestJob, why: Busy, now: float) -> None:
        """Ends the requests of a job that the line did not send."""
        for request in requests_of(job):  # a repetition says nothing about the first try
            outcome = job.error if isinstance(job, Repeat) else unsent(request, why)
            self._end(request, outcome, now)

    def _single(self, write: Write, result: Result, now: float, time: int) -> None:
        """Ends a write, or has it sent the other way where the device lacks the first one."""
        outcome = self._written(write, result, None, now, time)
        # Other refusals, such as a fault of the device, do not tell that it changed nothing.
        if (
            write.masked
            and isinstance(result, Refused)
            and (
                result.refusal is Refusal.ADDRESS
                or (result.unexecuted and result.refusal is not Refusal.BUSY)
            )
        ):
            self._schedule.requests.each_alone((write,), result)
        else:
            self._end(write, outcome, now)

    def _written(
        self, write: Write, result: Result, first: DeviceError | None, now: float, time: int
    ) -> Outcome:
        """Returns the outcome. `first`: the unclear end of the first try of a repeated write."""
        device = write.device
        match result:
            case Sent(acknowledged=False):
                self._pause(device)
                return result_of(write, now, time, acknowledged=False)
            case Sent():
                self._acknowledged(device, now, time)
                if result.held is None and result.refused_back is None:
                    return result_of(write, now, time)
                return _outcome(write, result, result.held, now, time)
            case Refused():
                self._refused(device, result, now, time)
                return first or result  # a refused repetition says nothing about the first try
        raise TypeError(f"{result!r} is no result of a write")

    def _written_together(
        self, job: WriteTogether, result: Result, now: float, time: int
    ) -> ReadBack | None:
        """Ends the writes, or returns the job that shows how many of them were done.

        A device can refuse an address after it has written those before it.
        """
        if isinstance(result, Refused):
            self._refused(job.device, result, now, time)
            if not result.unexecuted:
                return ReadBack(job.device, job.writes, result, job.run)
            self._schedule.requests.each_alone(job.writes, result)
            return None
        if not isinstance(result, Sent):
            raise TypeError(f"{result!r} is no result of a write")
        if result.acknowledged:
            self._acknowledged(job.device, now, time)
        else:
            self._pause(job.device)
        for write in job.writes:
            held = None
            if job.run is not None and result.held is not None and verified(write.tag):
                held = own_units(write, job.run, result.held)
            self._end(write, _outcome(write, result, held, now, time), now)
        return None

    def _acknowledged(self, device: Device, now: float, time: int) -> None:
        if device.shapes is not None:
            device.shapes.acknowledged(now)
        if device.health.needs_resync or device.health.state is not State.ONLINE:
            self._results.answered(device, now, time)

    def _read_back(self, job: ReadBack, result: Result, now: float, time: int) -> None:
        """Ends writes that were refused together. None is sent again: it may have been done.

        Another value does not show that a write was not done: the program of the PLC may have
        changed it since.
        """
        if not isinstance(result, HeldTogether):
            raise TypeError(f"{result!r} is no result of reading back")
        for write, held in zip(job.writes, result.units, strict=True):
            outcome: Outcome = job.error
            if isinstance(held, Refused):
                self._refused(job.device, held, now, time)
                if held.refusal is job.refused.refusal is Refusal.ADDRESS:
                    outcome = job.refused  # this is the address that does not exist
            elif held is not None:
                self._results.answered(job.device, now, time)
                if write.holds(held):
                    outcome = result_of(write, now, time, verified=True)
            self._end(write, outcome, now)

    def _confirmed(self, job: Confirm, result: Result, now: float, time: int) -> Repeat | None:
        """Ends the write, or returns its repetition. `result.held`: None without `verify`."""
        if not isinstance(result, Sent | Refused):
            raise TypeError(f"{result!r} is no result of a write")
        if isinstance(result, Refused):
            self._refused(job.device, result, now, time)
        held = result.held if isinstance(result, Sent) else None
        done = {
            write
            for write in job.writes
            if held is not None
            and verified(write.tag)
            and write.holds(own_units(write, job.run, held))
        }
        if done:
            self._results.answered(job.device, now, time, resynced=True)
        elif isinstance(result, Sent) and len(job.writes) == 1:
            (write,) = job.writes
            rule = write.tag.write
            if rule is not None and rule.repeat and now < write.expires:
                return Repeat(job.device, write, job.error)
        for write in job.writes:
            verdict = result_of(write, now, time, verified=True) if write in done else job.error
            self._end(write, verdict, now)
        return None

    def _commanded(self, command: Command, result: Result, now: float, time: int) -> None:
        device = command.device
        if isinstance(result, Refused):
            self._refused(device, result, now, time)
        elif isinstance(result, str):
            if command.broadcast:
                self._pause(device)
            else:
                self._results.answered(device, now, time)
                if device.shapes is not None:
                    device.shapes.acknowledged(now)
        if not isinstance(result, str | Exception):
            raise TypeError(f"{result!r} is no result of a command")
        self._end(command, result, now)

    def _refused(self, device: Device, error: Refused, now: float, time: int) -> None:
        self._results.answered(device, now, time)
        device.record.count_refusal(error)
        if device.shapes is not None:
            device.shapes.refused(now)

    def _pause(self, device: Device) -> None:
        """Pauses after a broadcast: the stations need time for it, and none replies."""
        self._effects.pause(device.turnaround.configured or BROADCAST_PAUSE)

    def _end(self, request: Request, outcome: Outcome, now: float) -> None:
        if _is_of_either(request.device, outcome, now):
            is_read = isinstance(request, Command) and request.span is not None
            outcome = Busy(UNPROVEN) if is_read else Unclear(EITHER)
        if isinstance(request, Write):
            if request.long is not None and isinstance(outcome, GatewayError):
                outcome = request.long.ended(outcome)
            request.device.record.count_write(now - request.submitted)
        self._effects.collected.append(RequestEnded(request, outcome))
        if isinstance(request, Write):
            if request.group is not None and isinstance(outcome, GatewayError):
                request.group.fail(request.tag)
                self._end_group(request.group)
            poll = self._schedule.reader(request.device, request.tag)
            if poll is not None and (request.group is None or not self._more(request.group, poll)):
                self._schedule.expedite(poll)  # the client sees the new value soon

    def _end_group(self, group: Group) -> None:
        """Ends the waiting writes of a group: they must not follow one that was not done."""
        for waiting in self._schedule.requests.of_group(group):
            self._effects.collected.append(RequestEnded(waiting, after_failed(waiting, group)))
            poll = self._schedule.reader(waiting.device, waiting.tag)
            if poll is not None:
                self._schedule.expedite(poll)  # it has tags that were written before

    def _more(self, group: Group, poll: PollEntry) -> bool:
        """Returns True if tags of the poll are still to be written: one poll shows them all."""
        schedule = self._schedule
        return any(
            schedule.reader(poll.device, write.tag) is poll
            for write in schedule.requests.waiting
            if isinstance(write, Write) and write.group is group
        )


def _is_of_either(device: Device, outcome: Outcome, now: float) -> bool:
    """Returns True for a reply that a second station with the number of the device may have sent.
    Its refusal does not tell that the right one changed nothing."""
    shapes = device.shapes
    if shapes is None or shapes.quiet != WARY or not shapes.proofs.twins.may_reply(now):
        return False
    if isinstance(outcome, WriteResult):
        return outcome.acknowledged
    return isinstance(outcome, str | Refused)


def result_of(
    write: Write, now: float, time: int, *, verified: bool = False, acknowledged: bool = True
) -> WriteResult:
    """Returns the result. `now` by the line's clock, `time` in ns since 1970."""
    took, note = now - write.submitted, RACE if write.races else ""
    return WriteResult(write.value, time, took, verified, acknowledged, note, write.origin)


def _outcome(
    write: Write, sent: Sent, held: Sequence[int] | None, now: float, time: int
) -> Outcome:
    """Returns the outcome of a write that was sent. `held`: its units, read back."""
    if not sent.acknowledged:
        return result_of(write, now, time, acknowledged=False)
    if sent.refused_back is not None and verified(write.tag):
        return Differs(f"acknowledged, but reading back was refused: {sent.refused_back}")
    if held is not None and sent.took:
        return Differs(f"the device took {_differing(write, held)}")
    if held is not None and not write.holds(held):
        return Differs(f"acknowledged, but the device now holds {_differing(write, held)}")
    return result_of(write, now, time, verified=held is not None)


def _differing(write: Write, held: Sequence[int]) -> str:
    """Names the value that was read back; of an array the elements that are others."""
    wanted, found = write.value, write.tag.decode(held)
    if not isinstance(wanted, tuple) or not isinstance(found, tuple):
        return repr(found)
    others = [n for n, (one, other) in enumerate(zip(wanted, found, strict=True)) if one != other]
    shown = ", ".join(f"{found[n]!r} in element {n}" for n in others[:_SHOWN])
    return shown + (f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else "")
