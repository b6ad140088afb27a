"""The telephone calls of a line with a modem: dials, serves the call, and hangs up."""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import NoReturn, Protocol, runtime_checkable

from gateway.engine.device.records import CallState
from gateway.engine.dial_schedule import NEVER, CallRules, DialSchedule
from gateway.engine.effects import Effect
from gateway.errors import Busy, CallEnded, LineDown
from gateway.line.channel import Channel
from gateway.line.rounds import ConnectionOpener
from gateway.transport import (
    ModemAddress,
    ModemSettings,
    OpenBelow,
    Port,
    Receiver,
    open_modem,
    open_port,
)
from gateway.transport.port import SerialSettings


@runtime_checkable
class CallPort(Port, Protocol):
    """The port of a modem, also between calls; or of connections, between rounds."""

    async def dial(self) -> None:
        """Returns when the carrier is there. Raises `CallEnded`, and `LineDown`."""

    async def hang_up(self) -> None:
        """Returns when the modem has hung up. Raises `LineDown`."""


@runtime_checkable
class Telephone(Protocol):
    """The port of a modem, which dials telephones too."""

    async def ring(self, number: str) -> None:
        """Returns when it was dialled. Raises `CallEnded`, and `LineDown`."""


MOST_RINGS = 8  # of one modem; beyond, `Busy`


class Rings:
    """Telephones that the modem dials between two calls, because of an alarm."""

    def __init__(self) -> None:
        self.calls: DialSchedule | None = None  # while the modem is there
        self._waiting = deque[tuple[str, asyncio.Future[None]]]()

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, number: str) -> "asyncio.Future[None]":
        if len(self._waiting) >= MOST_RINGS:
            raise Busy(f"{MOST_RINGS} telephones are waiting for the modem already")
        ended = asyncio.get_running_loop().create_future()
        self._waiting.append((number, ended))
        return ended

    async def dial_first(self, port: Telephone) -> None:
        """Dials the first one, unless its client has left. Raises `LineDown`."""
        number, ended = self._waiting[0]
        try:
            if not ended.done():
                await port.ring(number)
        except CallEnded as error:
            if not ended.done():
                ended.set_exception(error)
        else:
            if not ended.done():
                ended.set_result(None)
        self._waiting.popleft()

    def lose(self, why: str) -> None:
        """Ends all of them: the modem is lost."""
        self.calls = None
        while self._waiting:
            _, ended = self._waiting.popleft()
            if not ended.done():
                ended.set_exception(LineDown(why))


@dataclass(frozen=True, slots=True)
class ModemOpener:
    """Opens the port of a modem that dials."""

    where: ModemAddress
    serial: SerialSettings
    modem: ModemSettings
    opens: OpenBelow = open_port

    def __call__(self, receiver: Receiver) -> Awaitable[Port]:
        return open_modem(self.where, self.serial, self.modem, receiver, opens=self.opens)


def dialling(opener: Callable[[Receiver], Awaitable[Port]]) -> float:
    """Returns the seconds that a request may wait for a telephone call, or a connection."""
    match opener:
        case ModemOpener(modem=modem):
            return modem.dial_timeout
        case ConnectionOpener(delay=delay, rounds=True):
            return delay
    return 0.0


def rules_of(opener: Callable[[Receiver], Awaitable[Port]]) -> CallRules | None:
    """Returns the rules of its calls; None: its port stays open."""
    match opener:
        case ModemOpener(modem=modem):
            return CallRules(tries=modem.tries, retry_pause=modem.retry_pause, idle=modem.idle)
        case ConnectionOpener(delay=delay, rounds=True):
            return CallRules(tries=NEVER, retry_pause=1.0, idle=0.0, rounds=True, early=delay)
    return None


class CallingLine(Protocol):
    """The line that the calls serve."""

    rings: Rings

    def catch_up(self, now: float) -> None:
        """Raises `LineDown` when the port of the modem is lost."""

    def begin(self, port: Port) -> Channel: ...

    def deliver(self, effects: list[Effect]) -> None: ...

    async def idle(self, until: float) -> None: ...

    async def serve(self, channel: Channel) -> None: ...

    def end_call(self, calls: DialSchedule, why: CallEnded | None) -> None: ...


async def serve_calls(line: CallingLine, port: CallPort, calls: DialSchedule) -> NoReturn:
    """Serves one call after another, until the port of the modem is lost. Raises `LineDown`."""
    now = asyncio.get_running_loop().time
    try:
        while True:
            line.catch_up(now())
            if line.rings and isinstance(port, Telephone):
                calls.dial(now())
                await line.rings.dial_first(port)
                calls.record.enter(CallState.IDLE, now())
            due = calls.due(now())
            if due > now():
                if not line.rings:
                    await line.idle(due)
                continue
            await _call(line, port, calls, now)
    except LineDown as error:
        calls.record.lose(str(error), now())
        raise


async def _call(
    line: CallingLine, port: CallPort, calls: DialSchedule, now: Callable[[], float]
) -> None:
    """Makes one call. Raises `LineDown`."""
    ended: CallEnded | None = None
    try:
        calls.dial(now())
        await port.dial()
        channel = line.begin(port)
        line.deliver(calls.connect(now()))
        await line.serve(channel)
    except CallEnded as error:
        ended = error
    await port.hang_up()
    line.end_call(calls, ended)
