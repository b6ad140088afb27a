"""Performs one job on an open transaction: calls the driver, and decides nothing."""

from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.long_writes import LongWrite
from gateway.engine.device.reply_shapes import QUIET, UNPROVEN
from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    HeldTogether,
    Identified,
    Identify,
    Poll,
    Probe,
    ReadBack,
    Repeat,
    Result,
    Resynced,
    Sent,
    Settle,
    Transacted,
    WriteTogether,
)
from gateway.engine.jobs.requests import Command, Write
from gateway.engine.jobs.runs import needs_read, own_units, together, verified
from gateway.errors import (
    Busy,
    Refused,
    Took,
    Unclear,
)
from gateway.line.polling import RESULTS, read_poll
from gateway.line.transaction import Transaction
from gateway.protocols.capabilities import (
    ChangesBits,
    Controllable,
    Identifies,
    ScatteredWriter,
)
from gateway.protocols.driver import AnyDriver, Span

T = TypeVar("T")
TWO_REPLIES = "two replies arrived, and the first may be that to an earlier write"


@dataclass(frozen=True, slots=True)
class ProbeTalk:
    """The `Talk` of a probe. A short one waits less than `reply_timeout`."""

    transaction: Transaction
    timeout: float | None
    online: bool  # its device replied to the last request

    @property
    def may_echo(self) -> bool:
        """While the device was silent, an adapter may have begun to echo."""
        return self.transaction.may_begin_to_echo if not self.online else self.transaction.may_echo

    async def tell(self, frame: Any) -> None:
        await self.transaction.tell(frame)

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        return await self.transaction.ask(frame, reply, answers, self.timeout)


async def perform(job: Transacted, transaction: Transaction) -> Result:
    """Returns the result of the job. Every error of a device or of the port is a result."""
    try:
        if isinstance(job, Poll):
            return await read_poll(job, transaction)
        if isinstance(job, Identify):
            return await _identify(job, transaction)
        return await _perform(job, transaction)
    except RESULTS as error:
        return error


async def _perform(job: Transacted, transaction: Transaction) -> Result:
    driver: Any = job.device.settings.driver
    match job:
        case Settle(guard=guard, gap=gap):
            return await transaction.settle(guard, gap)
        case Probe(outstanding=outstanding, token=token, timeout=timeout):
            spans = job.device.probe_spans
            talk = ProbeTalk(transaction, timeout, job.device.state is State.ONLINE)
            return Resynced(await driver.resync(talk, outstanding, token, spans))
        case Write() | Repeat():
            return await _write(job.write if isinstance(job, Repeat) else job, transaction)
        case WriteTogether(run=Span() as run):
            return await _write_run(job, run, transaction)
        case WriteTogether(writes=writes) if isinstance(driver, ScatteredWriter):
            parts = [(write.tag.span, write.units) for write in writes]
            sending = driver.write_scattered(transaction, parts)
            return Sent(await _only_reply(sending, writes[0], transaction))
        case ReadBack():
            return await _read_back(job, transaction)
        case Confirm():
            return await _confirm(job, transaction)
        case Command(span=span) if span is not None or isinstance(driver, Controllable):
            return await _command(job, driver, transaction)
        case Answer(frame=frame):
            await transaction.tell(frame)
            return None
    raise TypeError(f"{job.device.name} cannot perform {job!r}")


async def _identify(job: Identify, talk: Transaction) -> Identified:
    device, told = job.device, dict[str, Sequence[str]]()
    driver, tags = device.settings.driver, device.settings.identity_tags
    names = device.settings.identity.keys() - {tag.name for tag in tags}
    if names and isinstance(driver, Identifies):
        told |= await driver.identify(talk, names)
    if job.token is not None:
        with _refused_is_unclear():
            await driver.resync(talk, None, job.token, device.probe_spans)
    for tag in tags:
        told[tag.name] = (str(tag.decode(await _held(device, tag.span, talk))),)
    return Identified(told)


@contextmanager
def _refused_is_unclear() -> Iterator[None]:
    try:
        yield
    except Refused as error:
        raise Unclear(f"its resync was refused too: {error}") from error


async def _resync_before(device: Device, span: Span | None, token: int, talk: Transaction) -> None:
    """Sends a resync whose reply differs from that to a read of the `span`. Raises `Busy`."""
    driver: Any = device.settings.driver
    try:
        await driver.resync(talk, span, token, device.spans_beside(span, token))
    except Refused as error:
        raise Busy(f"{device.name} refused the resync that goes first: {error}") from error


async def _prove_read(device: Device, talk: Transaction) -> None:
    """Waits until the own reply would have arrived too, where extra replies arrive, or one came
    sooner than the station can reply. Raises `Busy` if one did that could be it."""
    too_soon = talk.traffic.doubtful
    if device.is_doubtful or too_soon:
        gap = device.longest_reply if too_soon else device.settled_after
        settled = await talk.settle(device.longest_reply + gap, gap)
        if talk.traffic.contradicted or not settled.quiet:
            raise Busy(UNPROVEN)


async def _command(job: Command, driver: Any, transaction: Transaction) -> str:
    if job.resyncs.before is not None:
        await _resync_before(job.device, job.span, job.resyncs.before, transaction)
    if job.span is not None:
        units = await driver.read(transaction, job.span)
        await _prove_read(job.device, transaction)
        return " ".join(map(str, units))
    transaction.guarded = job.submitted
    try:
        answer: str = await driver.control(transaction, job.name, job.argument)
        return answer
    finally:
        transaction.guarded = None


async def _write(write: Write, talk: Transaction) -> Sent:
    """Writes one value, and reads it back if its tag has `verify`. A part changes in its word."""
    driver, tag, units = write.device.settings.driver, write.tag, write.units
    verify = tag.write is not None and tag.write.verify
    if write.resyncs.before is not None:
        await _resync_before(write.device, tag.span, write.resyncs.before, talk)
    if write.part is not None and not write.masked:
        (word,) = await driver.read(talk, tag.span)
        await _prove_read(write.device, talk)
        units = [write.part.into(word, write.units[0])]
    if write.masked and write.part is not None and isinstance(driver, ChangesBits):
        bits = write.part.into(0, write.units[0])
        sending = driver.change_bits(talk, tag.span, write.part.bits, bits)
    elif write.long is None:
        sending = driver.write(talk, tag.span, units)
    else:
        sending = _one_by_one(write, write.long, talk)
    try:
        acknowledged = await _only_reply(sending, write, talk)
    except Took as error:
        if not verify:
            return Sent(held=error.units, took=True)
        acknowledged = True
    if not acknowledged or not verify:
        return Sent(acknowledged)
    return await _sent_and_held(write.device, tag.span, talk)


async def _sent_and_held(device: Device, span: Span, talk: Transaction) -> Sent:
    """Returns the result of an acknowledged write whose span is read back."""
    try:
        return Sent(held=await _held(device, span, talk))
    except Refused as error:
        return Sent(refused_back=error)


async def _held(device: Device, span: Span, talk: Transaction) -> Sequence[int]:
    """Reads back what was written. Raises `Unclear` if the reply may be another one."""
    talk.traffic.doubtful = False
    units = await device.driver.read(talk, span)
    try:
        await _prove_read(device, talk)
    except Busy as error:
        raise Unclear(str(error)) from error
    return units


async def _one_by_one(write: Write, long: LongWrite, talk: Transaction) -> bool:
    """Sends the requests of a long write, and notes how far it comes."""
    driver, at = write.device.driver, 0
    for number, span in enumerate(long.spans):
        long.sends(number)
        try:
            await driver.write(talk, span, write.units[at : at + span.size])
        except Busy:
            long.not_sent(number)
            raise
        if long.tokens:
            await _prove_only_reply(write, span, long.tokens[number], talk)
        long.acknowledged(number)
        at += span.size
    return True


async def _write_run(job: WriteTogether, run: Span, talk: Transaction) -> Sent:
    """Writes a run of several writes, and reads it back once if a tag has `verify`."""
    driver, first = job.device.settings.driver, job.writes[0]
    held: Sequence[int] = [0] * run.size
    if first.resyncs.before is not None:
        await _resync_before(job.device, run, first.resyncs.before, talk)
    if needs_read(job.writes):
        held = await _read_before(driver, run, talk)
        await _prove_read(job.device, talk)
    sending = driver.write(talk, run, together(run, job.writes, held))
    acknowledged = await _only_reply(sending, first, talk, run)
    if not acknowledged or not any(verified(write.tag) for write in job.writes):
        return Sent(acknowledged)
    return await _sent_and_held(job.device, run, talk)


async def _read_before(driver: AnyDriver, run: Span, talk: Transaction) -> Sequence[int]:
    """Reads the words of a run. A refusal of this read shows that nothing was written."""
    try:
        return await driver.read(talk, run)
    except Refused as error:
        raise Refused(
            str(error), code=error.code, refusal=error.refusal, unexecuted=True
        ) from error


async def _only_reply(
    sending: Awaitable[bool], write: Write, talk: Transaction, run: Span | None = None
) -> bool:
    """Sends a write, then the resync that it needs. Raises `Unclear` if two replies arrived.

    `write`: the first of several; `run`: their addresses.
    """
    refused: Refused | Took | None = None
    talk.guarded = write.submitted
    try:
        acknowledged = await sending
    except (Refused, Took) as error:
        refused, acknowledged = error, False
    finally:
        talk.guarded = None
    token = write.resyncs.after
    if token is None and (talk.traffic.doubtful or isinstance(refused, Took)):
        token = write.device.health.spare_token
    if token is not None:
        await _prove_only_reply(write, run or write.tag.span, token, talk)
    if refused is not None:
        raise refused
    return acknowledged


async def _prove_only_reply(write: Write, span: Span, token: int, talk: Transaction) -> None:
    """Sends the resync after a write. Raises `Unclear` if another reply than its own arrived."""
    try:
        await _resync_after(write, span, token, talk)
    except Refused:  # its own reply, unless one more follows
        await talk.settle(2 * QUIET, QUIET)
    if talk.traffic.extra:
        if write.long is not None:
            write.long.doubt()
        raise Unclear(TWO_REPLIES)


async def _resync_after(write: Write, span: Span, token: int, talk: Transaction) -> None:
    """Sends the resync. If the device lacks its addresses, those of the last read follow."""
    device = write.device
    try:
        near = span if write.tag.polled else None
        await device.driver.resync(talk, near, token, device.probe_spans)
    except Refused:
        if device.good_reads.last is None:
            raise
        await device.driver.read(talk, device.good_reads.last)


async def _read_back(job: ReadBack, talk: Transaction) -> HeldTogether:
    """Reads the run with one request. If it is refused, the tags follow one by one."""
    driver, run = job.device.driver, job.run
    if run is not None and driver.cost(run) is not None:
        with suppress(Refused):
            whole = await _held(job.device, run, talk)
            return HeldTogether([own_units(write, run, whole) for write in job.writes])
    held: list[Sequence[int] | Refused | None] = []
    for span in (write.tag.span for write in job.writes):
        try:
            readable = driver.cost(span) is not None
            held.append(await _held(job.device, span, talk) if readable else None)
        except Refused as error:
            held.append(error)
    return HeldTogether(held)


async def _confirm(job: Confirm, talk: Transaction) -> Sent:
    driver = job.device.driver
    with _refused_is_unclear():
        await driver.resync(talk, job.outstanding, job.token, job.device.probe_spans)
    if not any(verified(write.tag) for write in job.writes):
        return Sent()
    return Sent(held=await _held(job.device, job.run, talk))
