"""An open port with its clock: the one place where bytes of a line leave and arrive."""

import asyncio
from collections.abc import Callable

import structlog

from gateway.errors import Garbled, LineDown
from gateway.line.wire_log import WireLog
from gateway.planning.wire_timing import WireTiming
from gateway.transport import Port

log = structlog.get_logger("gateway.line")
NEVER = float("inf")
FAST = 19200  # above this baud rate the millisecond of an event loop counts
SPIN = 0.001  # seconds of a silence that are then waited for by looking at the clock
LONGEST_WAIT = 1.0  # seconds for others to fall silent
SHORTEST_REPLY = 3  # characters; fewer are noise
KEPT = 64  # bytes before an echo that are kept


class Alarm:
    """One timer for many time-outs, hardly any of which is reached.

    Arming and cancelling a timer for each request costs more than all else a request needs. So
    one timer runs on, and `look` finds out who waits when it goes off.
    """

    __slots__ = ("_due", "_look", "_timer")

    def __init__(self) -> None:
        self._due = NEVER  # when the timer goes off
        self._look: Callable[[], float] = lambda: NEVER
        self._timer: asyncio.TimerHandle | None = None

    def by(self, when: float, look: Callable[[], float]) -> None:
        """Calls `look` at `when` or before, and no older one. It returns when it is due again."""
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


class Echo:
    """The echo of a two-wire adapter.

    With `echo: true` in the file our own requests are dropped as they come back. Without a word
    in the file the replies show whether the adapter echoes.
    """

    __slots__ = ("_early", "_line", "_logged", "_pending", "_setting", "found", "strip")

    def __init__(self, line: str, setting: bool | None) -> None:
        """`setting`: of the file; None: not said."""
        self._line = line
        self._setting = setting
        self._logged = False  # once for each line, not at every opening
        self.strip = bool(setting)
        self.opened()

    def opened(self) -> None:
        """The port was opened, perhaps with another adapter."""
        self.found = self._setting  # None: no reply has shown it yet
        self._pending = b""  # what must still come back
        self._early = b""  # what came instead, so far

    def sent(self, data: bytes) -> None:
        self._pending, self._early = data, b""

    @property
    def early(self) -> bytes:
        """What arrived while our own request did not come back."""
        return self._early

    def without(self, data: bytes) -> bytes:
        """Drops our own request and everything before it.

        Until it has come back whole nothing is believed: some acknowledgements look like it.
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

        Where it is the request once and nothing else, it may be an echo, or an acknowledgement
        that repeats the request. A damaged echo proves nothing either.
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
    """An open port, and when its wire was busy last."""

    __slots__ = (
        "_port",
        "alarm",
        "echo",
        "lost_by",
        "now",
        "quiet_since",
        "wire",
        "wire_log",
    )

    def __init__(self, port: Port, wire: WireTiming, wire_log: WireLog, echo: Echo) -> None:
        self.wire = wire
        self.wire_log = wire_log
        self.echo = echo
        echo.opened()
        self.now = asyncio.get_running_loop().time
        self.quiet_since = 0.0  # when the wire was busy last
        self.alarm = Alarm()  # for the time-outs of its transactions
        self.lost_by: LineDown | None = None
        self._port = port

    def send(self, data: bytes) -> None:
        """Raises `LineDown`."""
        if self.lost_by is not None:
            raise self.lost_by
        if self.echo.strip:
            self.echo.sent(data)
        if self.wire_log.active:
            self.wire_log.sent(data)
        self.quiet_since = self.now()
        self._port.write(data)

    def pause(self, seconds: float) -> None:
        """Keep quiet for so long: stations take in a broadcast."""
        self.quiet_since += seconds

    async def quiet(self, silence: float) -> None:
        """Waits for the silence before a request, by the clock: loops may wake early or late.

        Raises `Garbled` where others never fall silent.
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
