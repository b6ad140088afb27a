"""An open port with its clock, its echo, its silences and its wire log."""

import asyncio
from collections.abc import Callable

import structlog

from gateway.engine.device.station_silence import StationSilence
from gateway.engine.jobs.unanswered import Unanswered
from gateway.errors import Garbled, LineDown
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

    __slots__ = ("_timer", "due", "look")

    def __init__(self, look: Callable[[], float] = lambda: NEVER) -> None:
        """`look` is called at `due` or earlier, and returns the next time."""
        self.look = look
        self.due = NEVER  # the time of the timer
        self._timer: asyncio.TimerHandle | None = None

    def by(self, when: float) -> None:
        """Calls `look` at `when` or earlier."""
        if when < self.due:
            if self._timer is not None:
                self._timer.cancel()
            self.due = when
            self._timer = asyncio.get_running_loop().call_at(when, self._off)

    def cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self.due, self._timer = NEVER, None

    def _off(self) -> None:
        self.due, self._timer = NEVER, None
        self.by(self.look())


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
        "before",
        "found",
        "strip",
    )

    def __init__(self, line: str, setting: bool | None) -> None:
        """`setting`: of the file; None: not set."""
        self._line = line
        self._setting = setting
        self._logged = False  # once for each line, not at every opening
        self.found = setting
        self.strip = bool(setting)
        self.opened()

    def opened(self) -> None:
        """Starts again: the port was opened, perhaps with another adapter. That there was no echo
        is known as before, but not proven: an acknowledgement that could be one needs a resync."""
        if not self.absent_by_evidence:
            self.found = self._setting  # None: not yet known
        self.absent_at = -NEVER  # when a reply came without an echo last
        self._pending = b""  # the part of the echo that must still arrive
        self._early = b""  # bytes that arrived before the echo
        self.before = 0  # their number, once it has arrived

    def sent(self, data: bytes) -> None:
        self._pending, self._early, self.before = data, b"", 0

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
        rest, self.before = self._early[place + len(self._pending) :], place
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
        "alarm",
        "echo",
        "loop",
        "lost_by",
        "may_not_send",
        "now",
        "port",
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
        self.may_not_send = may_not_send
        self.unanswered = Unanswered()  # the numbered requests of this connection that timed out
        self.port = port

    def pause(self, seconds: float) -> None:
        """Keeps the line silent for so long, while stations process a broadcast."""
        self.quiet_since += seconds

    async def quiet(self, silence: StationSilence) -> None:
        """Waits for the silence before a request. Checks the clock: a loop may wake too early.

        Bytes that arrive meanwhile may bring the safe silence back. Raises `Garbled` if the wire
        does not become silent.
        """
        # Event loops round sleeps up by about a millisecond.
        spin = SPIN if self.wire.baudrate > FAST else 0.0
        until = max(self.quiet_since, self.now()) + LONGEST_WAIT
        while (wait := self.quiet_since + silence.kept - self.now()) > 0:
            if self.quiet_since > until:
                raise Garbled("the line is never quiet, nothing was sent: noise, or another master")
            await asyncio.sleep(wait - spin if wait > spin else 0)

    async def close(self) -> None:
        self.alarm.cancel()
        await self.port.close()


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
