"""One conversation on the wire: the `Talk` that drivers are given."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar

from gateway.errors import DeviceError, Evidence, Garbled, LineDown, NoReply
from gateway.line.clock import NEVER, Clock
from gateway.line.echo import Adapter
from gateway.line.wire_log import Recorder
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Codec, EndedByGap
from gateway.transport import Port

T = TypeVar("T")
MOST_OVERHEARD = 32  # frames of one conversation
LONGEST_WAIT = 1.0  # seconds for others to fall silent
KEPT = 64  # bytes of a failed conversation kept for the log


@dataclass(slots=True, eq=False)
class _Question:
    request: bytes
    answers: Callable[[Any], Any]
    until: float  # by the loop's clock
    reply: int  # characters of the longest answer
    future: "asyncio.Future[Any]"
    heard: int = 0  # characters that came for it


@dataclass(slots=True, eq=False)
class Turn:
    """What is said and heard between one request and its reply (or a few, one after another).

    Bytes that arrive while the turn is open come in by `received`. After a time-out the turn
    stays useful: `settle` goes on listening for the late answer.
    """

    port: Port
    new_codec: Callable[[], Codec[Any]]
    wire: WireTiming
    silence: float
    reply_timeout: float
    clock: Clock
    recorder: Recorder
    station: int
    echo: bool = False
    adapter: Adapter = field(default_factory=Adapter)
    beside: Callable[[Any], None] | None = None  # gets what answers nothing, at once
    in_doubt: bool = False  # an older question of another turn may still be answered
    started: float = 0.0  # when the first question was sent
    sent: int = 0  # characters, for the statistics
    heard: int = 0
    exchanges: int = 0  # questions answered
    turnaround: float = 0.0  # of all of them together, beyond the characters' own time
    passed: int = 0  # frames that answered nothing
    overheard: list[Any] = field(default_factory=list)  # the first of them
    _foreign: bool = False
    _expired: Callable[[Any], Any] | None = None  # what the timed-out question takes for an answer
    _late: "asyncio.Future[bool] | None" = None  # whether it came
    _came_late: bool = False
    _rest: bytes = b""  # what was heard since the last question or answer
    _answered: float = 0.0  # when the last answer came
    _echo: bytes = b""  # what must still come back
    _unechoed: bytes = b""  # what came instead, so far
    _open: list[_Question] = field(default_factory=list)
    _broken: Garbled | None = None
    _lost: LineDown | None = None
    _codec: Codec[Any] = field(init=False)
    _gap: asyncio.TimerHandle | None = None  # when a silence ends a frame

    def __post_init__(self) -> None:
        self._codec = self.new_codec()

    @property
    def may_echo(self) -> bool:
        """As in `Talk`. With `echo: true` our own words are dropped before anybody sees them."""
        return not self.echo and self.adapter.echoes is not False

    @property
    def unreturned(self) -> bytes:
        """What an echo has still to bring back."""
        return self._echo

    async def tell(self, frame: Any) -> None:
        data = self._codec.encode(frame)
        await self._quiet()
        self._send(data)
        # Nobody answers; the line is ours until the last character is out.
        self.clock.quiet_since += len(data) * self.wire.character

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        clock = self.clock
        if not self._open:
            if clock.quiet_since + self.silence > clock.now():
                await self._quiet()
            if self.heard:
                # It answers nothing: not a byte of it may be read as an answer.
                self._codec = self.new_codec()
                self._broken = None
            if self._gap is not None:
                self._gap.cancel()
            self._rest = b""
        data = self._codec.encode(frame)
        self._send(data)
        started, character = clock.quiet_since, self.wire.character
        spoken = (len(data) * (2 if self.echo else 1) + reply) * character
        until = started + spoken + self.reply_timeout
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        question = _Question(data, answers, until, reply, future)
        self._open.append(question)
        clock.alarm.by(until, self._look)
        try:
            answer = await future
        finally:
            self._open.remove(question)
        busy = (len(data) + question.heard) * character
        # Where several are open, each has its own part.
        alone = max(started, self._answered)
        self._answered = clock.quiet_since
        self.exchanges += 1
        own = self._answered - alone - busy
        if own > 0.0:
            self.turnaround += own
        return answer

    def received(self, data: bytes) -> None:
        """Bytes from the wire while this turn is open."""
        self.clock.quiet_since = self.clock.now()
        self.heard += len(data)
        if self._echo and not (data := self._strip_echo(data)):
            return
        if len(self._rest) < 4096:
            self._rest += data
        if self._broken is not None:
            return
        if self._gap is not None:
            self._gap.cancel()
        codec = self._codec
        self._take(codec.feed, data)
        gap = getattr(codec, "gap_timeout", None)  # before isinstance, which is slow
        if gap and isinstance(codec, EndedByGap) and self._broken is None:
            loop = asyncio.get_running_loop()
            self._gap = loop.call_later(gap, self._take, codec.expire)

    def _take(self, frames: Callable[..., list[Any]], *data: bytes) -> None:
        try:
            for frame in frames(*data):
                self._offer(frame)
        except Garbled as error:
            self._broken = error
            for question in self._open:
                _fail(question, error)

    def lost(self, error: LineDown) -> None:
        """The port is gone."""
        self._lost = error
        if self._late is not None and not self._late.done():
            self._late.set_result(False)
        for question in self._open:
            _fail(question, error)

    async def settle(self, guard: float, gap: float) -> float | None:
        """Keep quiet until nothing of this conversation can disturb the next.

        After a time-out: until the late answer has passed, or for `guard` seconds. After bytes
        that made no sense: until `gap` seconds have passed without one, at most `guard`.
        Returns how late the answer was, or None when it did not come.
        """
        loop = asyncio.get_running_loop()
        start = loop.time()
        if self._came_late:
            return 0.0
        until = start + guard
        if self._expired is None:
            while self._lost is None:
                quiet = min(self.clock.quiet_since + gap, until)
                if quiet <= loop.time():
                    break
                await self._late_until(quiet)
            return None
        if self._lost is not None or not await self._late_until(until):
            return None
        return loop.time() - start

    async def _late_until(self, end: float) -> bool:
        """Whether the late answer came before `end`; sooner, where the port is lost."""
        loop = asyncio.get_running_loop()
        self._late = loop.create_future()
        timer = loop.call_at(end, _give_up, self._late)
        try:
            return await self._late
        finally:
            timer.cancel()

    def _offer(self, frame: Any) -> None:
        for question in self._open:
            if question.future.done():
                continue
            try:
                answer = question.answers(frame)
            except DeviceError as error:
                _fail(question, error)
                return
            if answer is not None:
                if not self.echo:
                    self.adapter.heard(question.request, self._rest, question.reply)
                question.heard, self._rest = len(self._rest), b""
                question.future.set_result(answer)
                return
        if self._expired is not None and self._accepts(self._expired, frame):
            self._expired = None
            self._came_late = True
            if self._late is not None and not self._late.done():
                self._late.set_result(True)
            return
        self.passed += 1
        if self.beside is not None:
            self.beside(frame)
        if len(self.overheard) < MOST_OVERHEARD:
            self.overheard.append(frame)
        self._foreign = self._foreign or getattr(frame, "station", self.station) != self.station

    def _accepts(self, answers: Callable[[Any], Any], frame: Any) -> bool:
        try:
            return answers(frame) is not None
        except DeviceError:
            return not self.in_doubt  # a refusal names no question

    def _send(self, data: bytes) -> None:
        if self._lost is not None:
            raise self._lost
        if self.echo:
            self._echo, self._unechoed = data, b""
        self.recorder.sent(data)
        self.clock.quiet_since = self.clock.now()
        self.started = self.started or self.clock.quiet_since
        self.sent += len(data)
        self.port.write(data)

    async def _quiet(self) -> None:
        """Keep the silence before a request, by the clock: loops may wake early or late.

        Raises `Garbled` where it never comes.
        """
        loop = asyncio.get_running_loop()
        until = max(self.clock.quiet_since, loop.time()) + self.silence + LONGEST_WAIT
        while (wait := self.clock.quiet_since + self.silence - loop.time()) > 0:
            if self.clock.quiet_since + self.silence > until:
                raise Garbled("the line is never quiet, nothing was sent: noise, or another master")
            await asyncio.sleep(wait - self.clock.spin if wait > self.clock.spin else 0)

    def _strip_echo(self, data: bytes) -> bytes:
        """Drop our own request, which a two-wire adapter hands back, and all that came before it.

        Until it has come back whole nothing is believed: some acknowledgements look like it.
        """
        self._unechoed += data
        place = self._unechoed.find(self._echo)
        if place < 0:
            self._unechoed = self._unechoed[-KEPT - len(self._echo) :]
            return b""
        rest = self._unechoed[place + len(self._echo) :]
        self._echo = self._unechoed = b""
        return rest

    def _look(self) -> float:
        """End the questions whose time is over. Returns when to look again."""
        now, again = self.clock.now(), NEVER
        for question in self._open:
            if question.future.done():
                continue
            if question.until > now:
                again = min(again, question.until)
            else:
                self._expired = question.answers
                question.future.set_exception(self._verdict(question.request))
        return again

    def _verdict(self, request: bytes) -> DeviceError:
        heard = self._rest or self._unechoed
        shown = f"heard {heard[:KEPT].hex(' ')}"
        if not heard:
            return NoReply("no reply")
        if self._unechoed:
            return Garbled(f"our own request did not come back: {shown}", heard)
        if heard == request:
            return Garbled("heard only our own request", heard, evidence=Evidence.ECHO)
        if self.passed and self._foreign:
            return Garbled(f"another station spoke: {shown}", heard, evidence=Evidence.STATION)
        if self.passed:
            return Garbled(f"no answer to this: {shown}", heard, evidence=Evidence.SHAPE)
        return Garbled(f"no whole frame: {shown}", heard, evidence=Evidence.NOISE)


def _give_up(waiting: "asyncio.Future[bool]") -> None:
    if not waiting.done():
        waiting.set_result(False)


def _fail(question: _Question, error: Exception) -> None:
    if not question.future.done():
        question.future.set_exception(error)
