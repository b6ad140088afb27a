"""An open port with its clock, its echo and its wire log: sends all bytes of a line."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

from gateway.engine.jobs.unanswered import Unanswered
from gateway.errors import Busy, Garbled, LineDown
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from gateway.transport import Port

log = structlog.get_logger("gateway.line")
NEVER = float("inf")
FAST = 19200  # above this baud rate the millisecond of an event loop counts
SPIN = 0.001  # seconds at the end of a silence in which the clock is polled
LONGEST_WAIT = 1.0  # seconds for the wire to become silent
SHORTEST_REPLY = 3  # characters; fewer are noise
KEPT = 64  # bytes before an echo that are kept


class Alarm:
    """One timer for many time-outs, of which few are reached.

    A timer for each request costs more time than the rest of the request. So one timer keeps
    running, and `look` finds the requests whose time-out ended.
    """

    __slots__ = ("_due", "_look", "_timer")

    def __init__(self) -> None:
        self._due = NEVER  # the time of the timer
        self._look: Callable[[], float] = lambda: NEVER
        self._timer: asyncio.TimerHandle | None = None

    def by(self, when: float, look: Callable[[], float]) -> None:
        """Calls `look` at `when` or earlier, instead of an older one. It returns its next time."""
        self._look = look
        if when < self._due:
            if self._timer is not None:
                self._timer.cancel()
            self._due = when
            self._timer = asyncio.get_running_loop().call_at(when, self._off)

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._due, self._timer = NEVER, None

    def _off(self) -> None:
        self._due, self._timer = NEVER, None
        again = self._look()
        if again < NEVER:
            self.by(again, self._look)


@dataclass(slots=True)
class Expiry:
    """Calls the line at the deadline of its engine."""

    alarm: Alarm = field(default_factory=Alarm)
    at: float = NEVER  # the deadline when the alarm was set last


class Echo:
    """The echo of a two-wire adapter.

    With `echo: true` in the file, the echo of each request is dropped. Without the setting, the
    replies show if the adapter echoes.
    """

    __slots__ = (
        "_early",
        "_line",
        "_logged",
        "_pending",
        "_setting",
        "absent_at",
        "found",
        "strip",
    )

    def __init__(self, line: str, setting: bool | None) -> None:
        """`setting`: of the file; None: not set."""
        self._line = line
        self._setting = setting
        self._logged = False  # once for each line, not at every opening
        self.strip = bool(setting)
        self.opened()

    def opened(self) -> None:
        """Starts again: the port was opened, perhaps with another adapter."""
        self.found = self._setting  # None: not yet known
        self.absent_at = -NEVER  # when a reply came without an echo last
        self._pending = b""  # the part of the echo that must still arrive
        self._early = b""  # bytes that arrived before the echo

    def sent(self, data: bytes) -> None:
        self._pending, self._early = data, b""

    @property
    def absent_by_evidence(self) -> bool:
        """True if replies showed that there is no echo; it may begin later."""
        return self.found is False and self._setting is None

    @property
    def early(self) -> bytes:
        """Bytes that arrived while the echo did not."""
        return self._early

    def without(self, data: bytes) -> bytes:
        """Drops the echo of our own request, and everything before it.

        Before the complete echo no reply is accepted: some acknowledgements look like the echo.
        """
        if not self._pending:
            return data
        self._early += data
        place = self._early.find(self._pending)
        if place < 0:
            self._early = self._early[-KEPT - len(self._pending) :]
            return b""
        rest = self._early[place + len(self._pending) :]
        self._pending = self._early = b""
        return rest

    def without_rest(self, data: bytes) -> bytes:
        """Drops the rest of an echo that arrives after its transaction."""
        size = min(len(data), len(self._pending))
        if data[:size] == self._pending[:size]:
            self._pending = self._pending[size:]
            return data[size:]
        self._pending = b""
        return data

    def learn(self, request: bytes, heard: bytes, reply: int) -> None:
        """A reply of at most `reply` characters arrived; `heard` is all since the request.

        If this is only the request once, it may be an echo, or an acknowledgement that repeats
        the request. A damaged echo does not prove an echo either.
        """
        place = heard.find(request)
        if place < 0:
            if len(heard) <= reply:
                self.found = False
        elif len(heard) - place - len(request) >= SHORTEST_REPLY and not self.found:
            self.found = True
            if not self._logged:
                self._logged = True
                log.warning("adapter echoes", line=self._line, advice="set echo: true")


class Channel:
    """An open port, and the last time when its wire was busy."""

    __slots__ = (
        "_may_not_send",
        "_port",
        "alarm",
        "echo",
        "guarded",
        "loop",
        "lost_by",
        "now",
        "quiet_since",
        "unanswered",
        "wire",
        "wire_log",
    )

    def __init__(
        self,
        port: Port,
        wire: WireTiming,
        wire_log: WireLog,
        echo: Echo,
        *,
        may_not_send: Callable[[float, float], str] = lambda _since, _now: "",
    ) -> None:
        """`may_not_send`: returns the reason to refuse a write of this time, now."""
        self.wire = wire
        self.wire_log = wire_log
        self.echo = echo
        echo.opened()
        self.loop = asyncio.get_running_loop()
        self.now = self.loop.time
        # The last time when the wire was busy; a reply to the connection before may just end.
        self.quiet_since = self.now()
        self.alarm = Alarm()  # for the time-outs of its transactions
        self.lost_by: LineDown | None = None
        self.guarded: float | None = None  # the next frame is a write of this time
        self._may_not_send = may_not_send
        self.unanswered = Unanswered()  # the numbered requests of this connection that timed out
        self._port = port

    def check_duty(self) -> None:
        """Raises `Busy` if the next frame is a write that must not be sent now."""
        since, self.guarded = self.guarded, None
        if since is not None and (why := self._may_not_send(since, self.now())):
            raise Busy(why)

    def send(self, data: bytes, now: float) -> None:
        """Sends the bytes. Raises `LineDown`."""
        if self.lost_by is not None:
            raise self.lost_by
        if self.echo.strip:
            self.echo.sent(data)
        if self.wire_log.active:
            self.wire_log.sent(data)
        self.quiet_since = now
        self._port.write(data)

    def pause(self, seconds: float) -> None:
        """Keeps the line silent for so long, while stations process a broadcast."""
        self.quiet_since += seconds

    async def quiet(self, silence: float) -> None:
        """Waits for the silence before a request. Checks the clock: a loop may wake too early.

        Raises `Garbled` if the wire does not become silent.
        """
        # Event loops round sleeps up by about a millisecond.
        spin = SPIN if self.wire.baudrate > FAST else 0.0
        until = max(self.quiet_since, self.now()) + silence + LONGEST_WAIT
        while (wait := self.quiet_since + silence - self.now()) > 0:
            if self.quiet_since + silence > until:
                raise Garbled("the line is never quiet, nothing was sent: noise, or another master")
            await asyncio.sleep(wait - spin if wait > spin else 0)

    async def close(self) -> None:
        self.alarm.cancel()
        await self._port.close()


def channels(
    line: str,
    wire: WireTiming,
    echo: bool | None,
    wire_log: WireLog,
    may_not_send: Callable[[float, float], str],
) -> Callable[[Port], Channel]:
    """Returns a function that makes the channel of an open port. `echo`: of the file."""
    known = Echo(line, echo)  # what is learned of the adapter stays
    return lambda port: Channel(port, wire, wire_log, known, may_not_send=may_not_send)
