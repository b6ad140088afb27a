"""A line: one port, its devices, and the task that serves them.

The line decides nothing. It asks its engine for the next job, performs it, and passes the result
back; the engine's effects go to the clients, the sample sink and the log.
"""

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import structlog

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.dial_schedule import DialSchedule
from gateway.engine.effects import Effect, LogEvent, OnlineChange, Pause, RequestEnded, Samples
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Idle, Poll, Reopen, Result, Settle, Traffic
from gateway.engine.jobs.requests import WRITE_EXPIRY, Command, Group, Outcome, Request, Write
from gateway.errors import CallEnded, GatewayError, Lent, LineDown
from gateway.line.calling import CallPort, Rings, dialling, rules_of, serve_calls
from gateway.line.changing import Changeable, WaitingChange
from gateway.line.channel import NEVER, Alarm, Channel, channels
from gateway.line.opening import REOPEN_LONGEST, Loan, OpenPort, Pauses, own, pause
from gateway.line.perform import perform
from gateway.line.polling import RESULTS, perform_together
from gateway.line.send_permit import SendPermit
from gateway.line.transaction import Transaction
from gateway.line.wire_log import WireLog
from gateway.protocols.driver import Span
from gateway.tags import Sample, Tag, WriteResult
from gateway.transport import Port, Receiver
from gateway.transport.port import Noted

log = structlog.get_logger("gateway.line")
RESTS = (Idle, Reopen)  # jobs without a transaction; `Idle | Reopen` makes an object each time


class SampleSink(Protocol):
    """Receives the line's samples and device state changes, on the event loop."""

    def samples(self, samples: Sequence[Sample]) -> None: ...

    def online(self, device: Device, online: bool) -> None: ...


class Line:
    """The task of one line, and the entries for its clients."""

    def __init__(
        self,
        engine: Engine,
        open_port: OpenPort,
        sink: SampleSink,
        *,
        echo: bool | None = None,
        wall: Callable[[], int] = time.time_ns,
        duty: SendPermit | None = None,
    ) -> None:
        """`echo`: the port receives its own bytes; None: not known. `wall`: ns since 1970."""
        self.engine = engine
        self._open_port: OpenPort | Loan = open_port
        self._sink = sink
        self.wire_log = WireLog()
        duty = duty or SendPermit()
        self._new_channel = channels(engine.name, engine.wire, echo, self.wire_log, duty.why_not)
        self._wall = wall
        self.rings = Rings()
        self._channel: Channel | None = None
        self._transaction: Transaction | None = None
        self._lost: LineDown | None = None
        self._outcomes: dict[Request, asyncio.Future[Any]] = {}
        self._wake = asyncio.Event()
        self._alarm = Alarm(self._expire)  # at the deadline of the engine
        self._waiting: WaitingChange | None = None
        self.tried = asyncio.Event()  # set once the port was opened, or could not be

    # Clients

    @property
    def name(self) -> str:
        return self.engine.name

    @property
    def calls(self) -> DialSchedule | None:
        """None: no modem is there."""
        return self.rings.calls

    @property
    def dialling(self) -> float:
        return dialling(self._open_port)

    def write(
        self, device: Device, tag: Tag, units: Sequence[int], within: float = WRITE_EXPIRY
    ) -> asyncio.Future[WriteResult]:
        """Writes as soon as the current transaction ends, if that is `within` so many seconds.

        The future ends when the device has acknowledged, or raises `GatewayError`.
        """
        return self._submit(Write(device, tag, units, _now(), within))

    def write_group(
        self,
        device: Device,
        values: Sequence[tuple[Tag, Sequence[int]]],
        within: float = WRITE_EXPIRY,
    ) -> list[asyncio.Future[WriteResult]]:
        """Writes several tags in their order, as `write`. After the first that is not done the
        others are not sent: they raise `NotSent`. One alone may share a request with others."""
        now, group = _now(), Group() if len(values) > 1 else None
        writes = [Write(device, tag, units, now, within, group=group) for tag, units in values]
        loop = asyncio.get_running_loop()
        ends = [loop.create_future() for _ in writes]
        self._outcomes.update(zip(writes, ends, strict=True))
        self.deliver(self.engine.submit_group(writes, now))
        self._hasten(device)
        return ends

    def command(
        self, device: Device, name: str, argument: str, within: float = WRITE_EXPIRY
    ) -> asyncio.Future[str]:
        """Sends a command of the driver, such as run or stop. As `write`."""
        return self._submit(Command(device, name, argument, _now(), within))

    async def ring(self, number: str) -> None:
        """Dials a telephone, between two calls. Raises `LineDown` in the words of the modem."""
        if self.calls is None:
            raise LineDown(f"line {self.name}: its modem is not there")
        ended = self.rings.add(number)
        self._wake.set()
        await ended

    def peek(self, device: Device, span: Span, within: float = WRITE_EXPIRY) -> asyncio.Future[str]:
        """Reads any addresses once. The future has the units, with spaces between. As `write`."""
        return self._submit(Command(device, "peek", "", _now(), within, span))

    def _submit(self, request: Request) -> asyncio.Future[Any]:
        outcome = self._outcomes[request] = asyncio.get_running_loop().create_future()
        self.deliver(self.engine.submit(request, _now()))
        self._hasten(request.device)
        return outcome

    def _hasten(self, device: Device) -> None:
        """Wakes the line for a request, and ends a patient probe of another device early."""
        self._wake.set()
        within = self.engine.probe_timeout(device)
        if within is not None and self._transaction is not None:
            self._transaction.hasten(within)

    def expedite(self, device: Device, tag: Tag) -> None:
        """Polls the tag's block before all other polls."""
        self.engine.expedite(device, tag)
        self._wake.set()

    async def change(
        self, changes: Changes, devices: Sequence[DeviceSettings], applied: Callable[[], None]
    ) -> None:
        """Takes over changed devices when the current transaction has ended. Calls `applied` at
        once then: no sample comes between. `devices`: all of the line, for its simulated port.
        Call it again only after it has returned."""
        ended = asyncio.get_running_loop().create_future()
        self._waiting = WaitingChange(changes, devices, applied, ended)
        if self.engine.is_open:
            self._wake.set()
        else:
            self._apply()
        await ended

    def _apply(self) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self.deliver(self.engine.change(waiting.changes, _now()))
            if isinstance(opens := own(self._open_port), Changeable):
                opens.change(waiting.devices)
            waiting.applied()
            if not waiting.ended.done():
                waiting.ended.set_result(None)

    # Its port for another program

    async def lend(self, why: str, receiver: Receiver) -> Port:
        """Closes the line, and opens its port for another program, until `take_back`. Values are
        bad meanwhile, requests are refused. `why`: who has it. Raises `LineDown`."""
        if isinstance(self._open_port, Loan):
            raise LineDown("another program has the wire")
        lent = self._open_port = Loan(self._open_port, why, receiver)
        self.lost(Lent(why))
        await lent.left.wait()
        return await lent.opens(receiver)

    def take_back(self, holder: Receiver) -> None:
        """Has the line open its port again, if `holder` has it: its `receiver` when it was lent.
        What the program asked may still be answered."""
        if isinstance(lent := self._open_port, Loan) and lent.holder is holder:
            self._open_port = lent.opens
            lent.over.set()
            self.engine.inherits()

    # The receiver of the port

    def received(self, data: bytes) -> None:
        channel, transaction = self._channel, self._transaction
        if channel is None:  # still opening
            return
        if transaction is not None and transaction.has_sent:
            transaction.received(data)
            return
        if channel.wire_log.active:
            channel.wire_log.heard(data)
        now = channel.now()
        # The bytes may be the echo of a broadcast: its pause must not become shorter.
        channel.quiet_since = max(channel.quiet_since, now)
        if channel.echo.strip:
            data = channel.echo.without_rest(data)
        if data:
            effects = self.engine.received(data, now, self._wall())
            if self.wire_log.active:
                for effect in effects:
                    if isinstance(effect, Samples):
                        self.wire_log.learned(effect.samples)
            self.deliver(effects)
            self._wake.set()

    def lost(self, error: Exception) -> None:
        self._lost = error if isinstance(error, LineDown) else LineDown(str(error))
        if self._channel is not None:
            self._channel.lost_by = self._lost
        if self._transaction is not None:
            self._transaction.lost(self._lost)
        self._wake.set()

    def _unmatched(self, device: Device, frame: Any, echo: bool) -> None:
        self.deliver(self.engine.unmatched(device, frame, _now(), self._wall(), echo=echo))

    # The task

    async def run(self) -> None:
        """Serves the line until cancelled. Its errors do not end other lines."""
        pauses = Pauses(self.engine.name)
        while True:
            served, answered = 0.0, False
            try:
                error = await self._open_and_serve()
                if self.engine.is_open:
                    served = _now() - self.engine.record.since
                    answered = self.engine.was_answered
                self.deliver(self.engine.lost(error, _now(), self._wall()))
                self.tried.set()
            finally:
                self.deliver(self.engine.stopped(_now()))
                self._apply()
                await self._close()  # last, because closing can be slow
            if served > REOPEN_LONGEST or answered:
                pauses.restart()
            await pause(self._open_port, pauses.take())

    async def _open_and_serve(self) -> LineDown:
        """Opens the port and serves it. Returns the reason of the end."""
        name, self._lost = self.engine.name, None
        try:
            port = await self._open_port(self)
            channel = self.begin(port)
            log.info("line open", line=name)
            self.deliver(self.engine.opened(_now(), port.note if isinstance(port, Noted) else ""))
            self.tried.set()
            rules = rules_of(self._open_port)
            if rules is not None and isinstance(port, CallPort):
                calls = self.rings.calls = DialSchedule(self.engine, rules)
                await serve_calls(self, port, calls)
            await self.serve(channel)
        except LineDown as error:
            known = str(error) == self.engine.record.trouble
            (log.debug if known else log.warning)("line down", line=name, why=str(error))
            return error
        except Exception as error:  # an error in one line must not end the others
            log.exception("line failed", line=name)
            return LineDown(f"internal error: {error!r}")
        raise AssertionError("a port is served until it is lost")

    def begin(self, port: Port) -> Channel:
        """Begins to use an open port, or the next telephone call."""
        channel = self._channel = self._new_channel(port)
        channel.unanswered = self.engine.unanswered
        return channel

    def end_call(self, calls: DialSchedule, why: CallEnded | None) -> None:
        """Ends a telephone call, or a try of one. `why` None: it is complete."""
        working, self._transaction = self._transaction is not None, None
        if isinstance(self._lost, CallEnded):
            self._lost = None
        self.deliver(calls.end(why, _now(), self._wall(), working=working))

    def catch_up(self, now: float) -> None:
        """Does what waits for the end of a transaction. Raises `LineDown` when the port is lost."""
        if self._lost is not None:
            raise self._lost
        if self._waiting is not None and self.engine.is_idle:
            self._apply()
        if self.engine.deadline <= now:
            self._expire()

    async def _close(self) -> None:
        channel, self._channel = self._channel, None
        self._transaction = None
        self.rings.lose(f"line {self.name}: its modem was lost")
        self.engine.reach_by_modem(False)
        self._alarm.cancel()  # its timer would keep an ended line alive
        if channel is not None:
            await channel.close()

    async def serve(self, channel: Channel) -> None:
        """Serves the port until it is lost, or a telephone call until it is complete."""
        engine, now = self.engine, channel.now
        while True:
            begun = now()
            if self._lost is not None or self._waiting is not None or engine.deadline <= begun:
                self.catch_up(begun)
            job = engine.next(begun)
            if isinstance(job, RESTS):
                if await self._rest(job, begun):
                    return
                continue
            device, transaction = job.device, self._transaction
            if transaction is not None and isinstance(job, Settle):
                transaction.traffic = Traffic()
            else:
                transaction = self._transaction = Transaction(channel, device, self._unmatched)
            if isinstance(job, Poll) and device.window > 1:
                polls = (job, *engine.alongside(job, begun))
                await perform_together(polls, transaction, channel, self._conclude)
                continue
            if not isinstance(job, Poll) or job.block.listed or device.settings.verify_reads > 1:
                result = await perform(job, transaction)
            else:  # most jobs
                try:
                    result = await device.settings.driver.read(transaction, job.span)
                except RESULTS as error:
                    result = error
            if self.wire_log.active:
                self.wire_log.performed(job, result, begun, now())
            traffic = transaction.traffic
            self.deliver(engine.conclude(job, result, traffic, now(), self._wall()))

    async def _rest(self, job: Idle | Reopen, now: float) -> bool:
        """Waits for the next job. Returns True if the telephone call is complete."""
        if isinstance(job, Reopen):
            raise LineDown(job.why)
        self._transaction = None
        over = NEVER if self.calls is None else self.calls.over(now)
        if over > now:
            await self.idle(min(job.until, over))
        return over <= now

    def _conclude(self, poll: Poll, result: Result, traffic: Traffic) -> None:
        self.deliver(self.engine.conclude(poll, result, traffic, _now(), self._wall()))

    async def idle(self, until: float) -> None:
        """Waits until then, or for a request or bytes."""
        self._wake.clear()
        loop, wake = asyncio.get_running_loop(), self._wake.set
        timer = None if until == NEVER else loop.call_at(until, wake)  # cheaper than a time-out
        try:
            await self._wake.wait()
        finally:
            if timer is not None:
                timer.cancel()

    # Effects

    def deliver(self, effects: Sequence[Effect]) -> None:
        """Passes effects of the engine on, and sets the alarm for its deadline."""
        for effect in effects:
            if type(effect) is Samples:  # before `match`, which is slower
                self._sink.samples(effect.samples)
                continue
            match effect:
                case OnlineChange(device, online):
                    self._sink.online(device, online)
                case RequestEnded(request, outcome):
                    self._end(request, outcome)
                case Pause(seconds):
                    if self._channel is not None:
                        self._channel.pause(seconds)
                case LogEvent(level, event, fields):
                    getattr(log, level)(event, **fields)
        if self.engine.deadline < self._alarm.due:
            self._alarm.by(self.engine.deadline)

    def _end(self, request: Request, outcome: Outcome) -> None:
        waiting = self._outcomes.pop(request)
        if isinstance(request, Write) or request.span is None:  # no peek
            self.engine.record.wrote_at = _now()
        if waiting.done():  # the client no longer waits
            return
        if isinstance(outcome, GatewayError):
            waiting.set_exception(outcome)
        else:
            waiting.set_result(outcome)

    def _expire(self) -> float:
        """Lets the engine expire what is due. Returns its next deadline."""
        self.deliver(self.engine.expire(_now(), self._wall()))
        self._wake.set()
        return self.engine.deadline


def _now() -> float:
    return asyncio.get_running_loop().time()
