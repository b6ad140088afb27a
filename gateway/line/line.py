"""One wire, one task: whatever is said on a wire is said from here."""

import asyncio
import random
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

import structlog

from gateway.engine.device import Device, LineRecord, Standing
from gateway.engine.jobs import Idle, Poll, Probe
from gateway.engine.requests import Command, Done, Order, Told, Write
from gateway.engine.results import Consequences, Upstairs
from gateway.engine.schedule import Schedule
from gateway.engine.stray import Overheard
from gateway.engine.unsolicited import Answer, Listening
from gateway.errors import Busy, LineDown, Offline, Unclear
from gateway.line.clock import NEVER, Alarm, Clock
from gateway.line.echo import Adapter
from gateway.line.polling import Poller
from gateway.line.transaction import Turn
from gateway.line.wire_log import Recorder
from gateway.line.writing import Writer, together
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Span
from gateway.tags import Tag
from gateway.transport import Port, Receiver

log = structlog.get_logger("gateway.line")
REOPEN_FIRST, REOPEN_LONGEST = 0.2, 10.0
PATIENCE = 5.0  # a write that waited so long is not sent any more
FAST = 19200  # above this baud rate the millisecond of an event loop counts
GAP = 0.02  # quiet that ends a run of bytes nobody understood
BROADCAST_PAUSE = 0.1


class Line:
    """A port, the devices behind it, and the one task that talks to them."""

    def __init__(
        self,
        name: str,
        devices: Sequence[Device],
        wire: WireTiming,
        open_port: Callable[[Receiver], Awaitable[Port]],
        upstairs: Upstairs,
        wall: Callable[[], int],
        *,
        echo: bool | None = None,
        seed: int = 0,
    ) -> None:
        """`wall`: nanoseconds since 1970, for the samples' time stamps. `echo`: whether the port
        hears what it says; None: to be found out."""
        self.name = name
        self.devices = devices
        self.wire = wire
        self.record = LineRecord()
        self.recorder = Recorder(name)
        self.is_open = False
        self._open_port = open_port
        self._wall = wall
        self._echo = echo
        self._adapter = Adapter(echo)
        self._echoed = False  # and that has been told
        self._random = random.Random(seed)  # noqa: S311  (jitter, not a secret)
        self._clock = Clock(spin=0.001 if wire.baudrate > FAST else 0.0)
        self._schedule = Schedule(devices, 0.0, seed)
        self._then = Consequences(name, self._schedule, upstairs, wall)
        self._poller = Poller(self, self._then)
        self._writer = Writer(self, self._then, wall)
        self._listening = Listening(devices, self._then)
        self._overheard = Overheard(name, devices)
        self._port: Port | None = None
        self._turn: Turn | None = None
        self._down: LineDown | None = None
        self._wake = asyncio.Event()
        self._expiry = Alarm()

    # What others may ask of it

    def submit(self, device: Device, tag: Tag, units: Sequence[int], done: Done) -> None:
        """Write as soon as the current exchange ends. `done` gets the outcome, exactly once."""
        now = self._clock.now()
        write = Write(device, tag, units, now, now + PATIENCE, done)
        for older in self._schedule.orders.superseded(write):
            older.done(Busy("a newer value took its place; not sent"))
        self._accept(write)

    def command(self, device: Device, name: str, argument: str, done: Told) -> None:
        """Have the device run, stop, ...: one of its driver's controls. `done` as in `submit`."""
        now = self._clock.now()
        self._accept(Command(device, name, argument, now, now + PATIENCE, done))

    def _accept(self, order: Order) -> None:
        if not self.is_open:
            order.done(LineDown(self.record.trouble or f"line {self.name} is not open"))
        elif not self._schedule.reachable(order.device, self._clock.now()):
            order.done(_offline(order.device))
        elif not self._schedule.orders.submit(order):
            order.done(Busy(f"line {self.name}: too many orders are waiting; not sent"))
        else:
            self._expiry.by(order.expires, self._expire)
            self._wake.set()

    def _expire(self) -> float:
        """What waited too long is not sent any more, also while one conversation takes long.

        Returns when to look again.
        """
        orders, now = self._schedule.orders, self._clock.now()
        for order in orders.expired(now):
            waited = f"waited {now - order.submitted:.1f} s for the line"
            refused = isinstance(order, Write) and order.alone
            sent = "refused together with others, and not sent alone" if refused else "not sent"
            order.done(Busy(f"{waited}; {sent}"))
        return orders.first.expires if orders else NEVER

    def refresh(self, device: Device, tag: Tag) -> None:
        """Poll the tag's block before all other polls."""
        self._then.hasten(device, tag)
        self._wake.set()

    def polls(self, device: Device) -> Sequence[Poll]:
        """What is asked of it, with what was measured."""
        return self._schedule.polls(device)

    def reader(self, device: Device, tag: Tag) -> Poll | None:
        """What reads the tag; None where its value comes unasked."""
        return self._schedule.reader(device, tag)

    # The ear of the port

    def received(self, data: bytes) -> None:
        self.recorder.heard(data)
        if self._turn is not None and self._turn.sent:
            self._turn.received(data)
        else:  # before the first question there is nothing to answer
            now = self._clock.now()
            # No less quiet than is kept after a broadcast, whose echo this may be.
            self._clock.quiet_since = max(self._clock.quiet_since, now)
            self.record.unasked += len(data)
            self._overheard.idle(data)
            self._listening.received(data, now)
            self._wake.set()

    def lost(self, error: Exception) -> None:
        self._down = error if isinstance(error, LineDown) else LineDown(str(error))
        if self._turn is not None:
            self._turn.lost(self._down)
        self._wake.set()

    # The task

    async def run(self) -> None:
        """Serve the line until cancelled; what goes wrong on it stays on it."""
        self._clock.now = asyncio.get_running_loop().time
        pause = REOPEN_FIRST
        while True:
            try:
                trouble = await self._open_and_serve()
                served = self._clock.now() - self.record.since if self.is_open else 0.0
                self.record.went_down(trouble, served)
                self._then.line_down(trouble)  # told before closing, which may take a while
            finally:
                await self._close()
            if served > REOPEN_LONGEST:
                pause = REOPEN_FIRST
            await asyncio.sleep(pause * self._random.uniform(0.8, 1.2))
            pause = min(2 * pause, REOPEN_LONGEST)

    async def _open_and_serve(self) -> str:
        """Why it ended."""
        self._down = None
        try:
            self._port = await self._open_port(self)
            self.is_open = True
            self.record.came_up(self._clock.now())
            self._adapter.echoes = self._echo
            log.info("line open", line=self.name)
            self._then.line_up()
            self._listening.opened(self._clock.now())
            await self._serve()
        except LineDown as error:
            tell = log.debug if str(error) == self.record.trouble else log.warning
            tell("line down", line=self.name, why=str(error))  # once, not at every new try
            return str(error)
        except Exception as error:  # the bulkhead: lines must not sink together
            log.exception("line failed", line=self.name)
            return f"internal error: {error!r}"
        return "closed"

    async def _close(self) -> None:
        self.is_open = False
        self._then.overdue.stop()
        for write in self._schedule.orders.withdraw():
            write.done(LineDown(f"line {self.name} went down; not sent"))
        port, self._port = self._port, None
        if port is not None:
            await port.close()

    async def _serve(self) -> None:
        while self._down is None:
            now = self._clock.now()
            self._expire()
            match self._listening.next(now) or self._schedule.next(now):
                case Poll() as poll:
                    await self._poller.poll(poll, now)
                case Answer() as answer:
                    with self.turn_with(answer.device) as turn:
                        await answer.give(turn)
                case Write() as write:
                    others = self._schedule.orders.companions(write, together)
                    await self._writer.write(write, others)
                    if self._schedule.orders:  # some may be back, refused together
                        self._expiry.by(self._schedule.orders.first.expires, self._expire)
                case Command() as command:
                    await self._writer.command(command)
                case Probe(device):
                    await self._poller.probe(device, now)
                case Idle(until):
                    await self._idle(until)
        raise self._down

    async def _idle(self, until: float) -> None:
        self._wake.clear()
        until = min(until, self._listening.due)
        with suppress(TimeoutError):
            async with asyncio.timeout_at(None if until == float("inf") else until):
                await self._wake.wait()

    # Conversations

    @contextmanager
    def turn_with(self, device: Device) -> Iterator[Turn]:
        turn = self.begin(device)
        try:
            yield turn
        finally:
            self.end(device, turn)

    def begin(self, device: Device) -> Turn:
        """A conversation; `end` must follow."""
        if self._port is None or self._down is not None:
            raise self._down or LineDown(f"line {self.name} is not open")
        turn = self._turn = Turn(
            self._port,
            device.driver.codec,
            self.wire,
            self.wire.silence(device.timing),
            device.timing.reply_timeout,
            self._clock,
            self.recorder,
            device.driver.station,
            bool(self._echo),
            self._adapter,
            self._listening.beside(device),
            device.doubtful,
        )
        return turn

    def end(self, device: Device, turn: Turn) -> None:
        """It is over: what it took is counted."""
        self._turn = None
        characters = (turn.sent + turn.heard) * self.wire.character
        self.record.busy += characters
        self.record.turnarounds += turn.turnaround
        device.conversed(turn.exchanges, characters, turn.turnaround)
        if turn.passed:
            device.record.unasked += turn.passed
            self._overheard.frames(device, turn.overheard)
        self._listening.ended(device, turn)
        if self._adapter.echoes and not self._echoed:
            self._echoed = True
            log.warning("the adapter echoes: set echo: true", line=self.name)

    async def unclear(self, device: Device, turn: Turn, error: Unclear, asked: Span | None) -> None:
        """Note what was heard and keep quiet until nothing of it can disturb what comes next."""
        before = self._then.doubt(device, error, asked)
        guard = 0.0 if before is Standing.SILENT else device.late_guard
        late = await turn.settle(guard, max(GAP, 4 * self.wire.character))
        self._then.unclear(device, before, self._clock.now() - turn.started, late)
        if device.standing is Standing.SILENT:
            for write in self._schedule.orders.withdraw(device):
                write.done(_offline(device))

    def hold(self, device: Device) -> None:
        """After a broadcast: the stations need time to take it in, whatever one takes to answer."""
        self._clock.quiet_since += device.turnaround or BROADCAST_PAUSE


def _offline(device: Device) -> Offline:
    return Offline(f"{device.name} does not answer; nothing was sent")
