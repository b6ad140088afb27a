"""A modem on a port: dials or answers, and passes bytes through while a call lasts."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import AsyncExitStack, suppress
from typing import Any, Protocol, runtime_checkable

import serialx
import structlog

from gateway.errors import CallEnded, LineDown
from gateway.transport.at import CALLING, NEVER, AtModem
from gateway.transport.modem_events import (
    Broken,
    Connected,
    Ended,
    Event,
    Failed,
    ModemSettings,
    Ready,
    Received,
    Send,
    SetDtr,
    State,
)
from gateway.transport.port import Port, Receiver
from gateway.transport.stream import StreamPort

log = structlog.get_logger("gateway.line")
LOST = "carrier lost"  # the result of a call
LOOK = 0.25  # seconds between two looks at the signal CD
LONGEST_ANSWER = 1.0  # seconds of a modem that hangs up while its port is closed


class Signals(Protocol):
    """The signals DTR and CD of a port."""

    async def carrier(self) -> bool | None:
        """Returns the signal CD; None: the port has none."""

    async def set_dtr(self, on: bool) -> None: ...


@runtime_checkable
class Called(Protocol):
    """A receiver that knows of each call when it begins."""

    def call_began(self) -> None: ...


class SerialSignals:
    """DTR and CD of a serial port. A pseudo terminal and a network port have neither."""

    def __init__(self, port: Port) -> None:
        transport = port.transport if isinstance(port, StreamPort) else None
        self._serial = transport if isinstance(transport, serialx.SerialTransport) else None

    async def carrier(self) -> bool | None:
        if self._serial is not None:
            with suppress(OSError, serialx.SerialException):
                pins = await self._serial.get_modem_pins()
                return None if pins.car is serialx.PinState.UNDEFINED else pins.car.to_bool()
        return None

    async def set_dtr(self, on: bool) -> None:
        if self._serial is not None:
            with suppress(OSError, serialx.SerialException):
                await self._serial.set_modem_pins(dtr=on)


class ModemPort:
    """A `Port` that exists between calls too: `write` raises `CallEnded` then."""

    def __init__(
        self, name: str, settings: ModemSettings, receiver: Receiver, *, answers: bool
    ) -> None:
        """`answers`: takes incoming calls, and passes their bytes to `receiver`."""
        self.name = name
        self.modem = settings
        self._modem = AtModem(settings, answers=answers)
        self._receiver = receiver
        self._port: Port | None = None
        self._signals: Signals | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._waiting: asyncio.Future[None] | None = None  # for the end of a request
        self._tasks: set[asyncio.Task[None]] = set()
        self._watch: asyncio.Task[None] | None = None  # of the signal CD, in a call
        self._carrier: bool | None = None  # between calls; False: the signal is alive
        self._loss: LineDown | None = None

    async def open(
        self,
        opens: Callable[[Receiver], Awaitable[Port]],
        signals: Callable[[Port], Signals] = SerialSignals,
    ) -> None:
        """Opens the port of the modem, and sets the modem up. Raises `LineDown`."""
        self._port = await opens(self)
        async with AsyncExitStack() as failed:
            failed.push_async_callback(self.close)
            self._signals = signals(self._port)
            self._carrier = await self._signals.carrier()
            self._modem.pins.dtr = self._carrier is not None
            await self._ended(self._modem.open)
            failed.pop_all()

    async def dial(self) -> None:
        """Returns when the carrier is there. Raises `CallEnded` in the words of the modem."""
        if self._signals is not None:
            self._carrier = await self._signals.carrier()
        await self._ended(self._modem.dial)

    async def ring(self, number: str) -> None:
        """Dials a telephone, which has no carrier. Returns when it was dialled, and the modem has
        hung up. Raises `CallEnded` in the words of the modem."""
        await self._ended(lambda now: self._modem.ring(number, now))

    async def hang_up(self) -> None:
        """Returns when the modem has hung up. Raises `LineDown` if it does not."""
        await self._ended(self._modem.hang_up)

    def write(self, data: bytes) -> None:
        """Raises `CallEnded` between calls: the modem would take data for commands."""
        if self._port is None or self._modem.state is not State.ONLINE:
            raise CallEnded(f"{self.name}: no call", LOST)
        self._port.write(data)

    async def close(self) -> None:
        """Closes the port of the modem: DTR falls, and the call with it. Else hangs up first."""
        calling = self._modem.state in CALLING
        if calling and not self._modem.pins.dtr and self._loss is None:
            with suppress(LineDown, TimeoutError):
                async with asyncio.timeout(2 * self.modem.guard + LONGEST_ANSWER):
                    await self.hang_up()
        port, self._port = self._port, None
        if self._timer is not None:
            self._timer.cancel()
        for task in list(self._tasks):
            task.cancel()
        if port is not None:
            await port.close()

    # The receiver of the port below

    def received(self, data: bytes) -> None:
        self._do(self._modem.feed(data, _now()))

    def lost(self, error: Exception) -> None:
        self._loss = error if isinstance(error, LineDown) else LineDown(str(error))
        if not self._end(self._loss):
            self._receiver.lost(self._loss)

    # The machine

    async def _ended(self, request: Callable[[float], Sequence[Event]]) -> None:
        """Starts a request to the modem, and waits for its end."""
        if self._loss is not None:
            raise LineDown(str(self._loss))
        waiting = self._waiting = asyncio.get_running_loop().create_future()
        try:
            self._do(request(_now()))
            await waiting
        finally:
            self._waiting = None

    def _end(self, error: Exception | None) -> bool:
        """Ends the waiting request. Returns False if there is none."""
        waiting = self._waiting
        if waiting is None or waiting.done():
            return False
        if error is None:
            waiting.set_result(None)
        else:
            waiting.set_exception(error)
        return True

    def _tick(self) -> None:
        self._timer = None
        self._do(self._modem.tick(_now()))

    def _do(self, events: Sequence[Event]) -> None:
        for event in events:
            try:
                self._one(event)
            except LineDown as error:  # the port below cannot be written
                self.lost(error)
                return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._modem.due < NEVER and self._port is not None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_at(self._modem.due, self._tick)

    def _one(self, event: Event) -> None:
        match event:
            case Received(data):
                self._receiver.received(data)
            case Send(data) if self._port is not None:
                self._port.write(data)
            case SetDtr(on) if self._signals is not None:
                self._start(self._signals.set_dtr(on))
            case Connected(text):
                log.info("call connected", port=self.name, modem=text)
                self._watch = self._start(self._watch_carrier())
                if isinstance(self._receiver, Called):
                    self._receiver.call_began()
                self._end(None)
            case Failed(why):
                log.info("call failed", port=self.name, modem=why)
                word, _, _ = why.partition(":")
                self._end(CallEnded(f"{self.name}: {why}", word))
            case Ready():
                self._end(None)
            case Ended(why):
                log.info("call ended", port=self.name, modem=why)
                self._receiver.lost(CallEnded(f"{self.name}: {why}", LOST))
            case Broken(why):
                self.lost(LineDown(f"{self.name}: {why}"))

    def _start(self, work: Coroutine[Any, Any, None]) -> "asyncio.Task[None]":
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _watch_carrier(self) -> None:
        """Reports the loss of the signal CD. A signal that was always on says nothing."""
        if self._signals is None or self._carrier is not False:
            return
        seen = False
        while self._modem.state is State.ONLINE:
            on = await self._signals.carrier()
            if seen and on is False:
                self._do(self._modem.carrier_lost())
                return
            self._modem.pins.carrier = seen = seen or bool(on)
            await asyncio.sleep(LOOK)


def _now() -> float:
    return asyncio.get_running_loop().time()
