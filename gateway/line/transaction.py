"""One transaction: requests to one device, their replies, their time-outs and late replies."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast

from gateway.engine.device.device import Device
from gateway.engine.device.twins import answers_again
from gateway.engine.jobs.jobs import Settled, Traffic
from gateway.errors import Busy, DeviceError, Evidence, Garbled, LineDown
from gateway.line.channel import NEVER, SHORTEST_REPLY, Channel
from gateway.line.timed_out import LateReply, verdict
from gateway.protocols.capabilities import LooseRefusals, UnnumberedReplies
from gateway.protocols.driver import Codec, EndedByGap

T = TypeVar("T")
MOST_REMEMBERED = 4096  # bytes of one reply
SHORTEST_COMMAND = 8  # characters of another computer; fewer are noise


@dataclass(slots=True, eq=False)
class _Request:
    data: bytes
    frame: Any
    answers: Callable[[Any], Any]
    until: float  # by the line's clock
    reply: int  # characters of the longest reply
    future: "asyncio.Future[Any]"
    sent: float  # by the line's clock
    heard: int = 0  # characters of its reply
    equal: bool = False  # its reply was equal to it


class Transaction:
    """The `Talk` that a driver gets.

    The line passes to `received` all bytes that arrive while it is open. After a time-out it
    stays open: `settle` waits for the late reply.
    """

    __slots__ = (
        "_answered",
        "_broken",
        "_channel",
        "_codec",
        "_device",
        "_gap",
        "_heard",
        "_late",
        "_needs_resync",
        "_on_unmatched_frame",
        "_open",
        "_stray",
        "guarded",
        "has_sent",
        "traffic",
    )

    def __init__(
        self,
        channel: Channel,
        device: Device,
        on_unmatched_frame: Callable[[Device, Any, bool], None] | None = None,
    ) -> None:
        """`on_unmatched_frame` gets each frame that is no reply, at once; True for an echo."""
        self.has_sent = False  # earlier bytes do not belong to it
        # The next frame is the write of a client, submitted then: it is sent only if the duty is
        # proven in that moment.
        self.guarded: float | None = None
        self.traffic = Traffic()
        self._channel = channel
        self._device = device
        self._on_unmatched_frame = on_unmatched_frame
        # A request of an older transaction may still be answered.
        self._needs_resync = device.health.needs_resync
        self._codec: Codec[Any] = device.settings.driver.codec()
        self._open: list[_Request] = []
        self._broken: Garbled | None = None
        self._heard = b""  # since the last request or reply
        self._answered = 0.0  # when the last reply arrived
        self._stray: Evidence | None = None  # of frames that were no reply
        self._late: LateReply | None = None
        self._gap: asyncio.TimerHandle | None = None  # when a silence ends a frame

    @property
    def may_echo(self) -> bool:
        """As in `Talk`. With `echo: true` no driver gets our own requests."""
        echo = self._channel.echo
        return not echo.strip and echo.found is not False

    @property
    def may_begin_to_echo(self) -> bool:
        """As `may_echo`, if an echo may begin that replies did not show before."""
        return self.may_echo or self._channel.echo.absent_by_evidence

    async def tell(self, frame: Any) -> None:
        data = self._codec.encode(frame)
        channel = self._channel
        await channel.quiet(self._device.silence)
        self._send(data, channel.now())
        # No reply follows; the wire is busy until the last character is out.
        channel.pause(len(data) * channel.wire.character)

    async def ask(
        self,
        frame: Any,
        reply: int,
        answers: Callable[[Any], T | None],
        within: float | None = None,
    ) -> T:
        """As in `Talk`. `within`: seconds in place of `reply_timeout`, for a short probe."""
        channel, device = self._channel, self._device
        started = channel.now()
        if not self._open:
            if channel.quiet_since + device.silence.kept > started:
                await channel.quiet(device.silence)
                started = channel.now()
            if self.has_sent or self.traffic.heard:
                self._begin_hearing()
            silence = started - channel.quiet_since
            if silence < self.traffic.silence:
                self.traffic.silence = silence
        data, character = self._codec.encode(frame), channel.wire.character
        spoken = (len(data) * (2 if channel.echo.strip else 1) + reply) * character
        wait = device.settings.timing.reply_timeout if within is None else within
        until = started + spoken + wait
        unanswered = channel.unanswered
        if unanswered.requests:
            until += max(0.0, unanswered.held_up_until(device) - started)
        alarm = channel.alarm
        alarm.look = self._expire
        if until < alarm.due:
            alarm.by(until)
        self._send(data, started)
        future: asyncio.Future[T] = channel.loop.create_future()
        request = _Request(data, frame, answers, until, reply, future, started)
        self._open.append(request)
        try:
            answer = await future
        finally:
            self._open.remove(request)
        if unanswered.requests:
            unanswered.answered(started, channel.quiet_since)
        busy = (len(data) + request.heard) * character
        # Of several outstanding requests, each has its own part of the time.
        alone = max(started, self._answered) if self._answered else started
        self._answered = answered = channel.quiet_since
        traffic = self.traffic
        traffic.exchanges += 1
        own, replies = answered - alone - busy, device.record.replies
        too_soon = (
            own < replies.soonest and device.shapes is not None and replies.is_too_soon(own, busy)
        )
        if too_soon or request.equal:
            unproven = started - channel.echo.absent_at
            traffic.doubtful |= too_soon or device.may_be_echo(own, unproven)
        if own > 0.0:
            traffic.turnaround += own
        else:
            traffic.ahead = min(traffic.ahead, own / busy)
        return answer

    def _send(self, data: bytes, now: float) -> None:
        """Sends the bytes. Raises `LineDown`, and `Busy` for a write that must not be sent now."""
        channel = self._channel
        if (since := self.guarded) is not None:
            self.guarded = None
            if why := channel.may_not_send(since, now):
                raise Busy(why)
        if channel.lost_by is not None:
            raise channel.lost_by
        self.has_sent = True
        if channel.echo.strip:
            channel.echo.sent(data)
        if channel.wire_log.active:
            channel.wire_log.sent(data)
        channel.quiet_since = now
        channel.port.write(data)
        self.traffic.sent += len(data)

    def _begin_hearing(self) -> None:
        """Drops earlier bytes: they must not become part of the reply."""
        if len(self._heard) >= SHORTEST_COMMAND and self._stray is None:
            self.traffic.strange = True
        if self._heard or self.traffic.heard or self._broken is not None:
            self._codec = self._device.settings.driver.codec()
            self._broken = None
        if self._gap is not None:
            self._gap.cancel()
        self._heard = b""

    def received(self, data: bytes) -> None:
        """Takes bytes that arrived at the port."""
        channel = self._channel
        if channel.wire_log.active:
            channel.wire_log.heard(data)
        now = channel.quiet_since = channel.now()
        if self._open and self._open[0].until <= now:
            self._expire()  # the loop stood still: these bytes may be as old as the request
        self.traffic.heard += len(data)
        if channel.echo.strip and not (data := channel.echo.without(data)):
            return
        if len(self._heard) < MOST_REMEMBERED:
            self._heard += data
        if self._broken is not None:
            return
        if self._gap is not None:
            self._gap.cancel()
        self._take(self._codec.feed, data)
        if self._broken is None:
            if _may_end_by_gap(type(self._codec)):
                self._expect_gap(cast("EndedByGap[Any]", self._codec))
            elif self._heard and self._open and (quiet := self._spoiled_after()) is not None:
                self._gap = channel.loop.call_later(quiet, self._spoiled)

    def _expect_gap(self, codec: EndedByGap[Any]) -> None:
        """Sets the timer for a silence that ends the frame."""
        if codec.pending and all(request.future.done() for request in self._open):
            self.traffic.strange = True  # another frame begins behind the reply
        if gap := codec.gap_timeout:
            self._gap = self._channel.loop.call_later(gap, self._gap_ended, codec, gap)

    def _gap_ended(self, codec: EndedByGap[Any], gap: float) -> None:
        """Takes the frame that the silence ended, unless the loop stood still for too long."""
        if self._open and self._open[0].until + gap <= self._channel.now():
            self._expire()
        self._take(codec.expire)

    def _spoiled_after(self) -> float | None:
        """Returns the silence after which a reply of full length is spoiled; None: it goes on.

        Nothing else follows: the station has replied sooner before.
        """
        request, device = self._open[0], self._device
        if request.future.done() or device.shapes is None or self._stray is not None:
            return None
        echo = 0 if self._channel.echo.strip or not self.may_echo else len(request.data)
        return None if len(self._heard) < request.reply + echo else device.late_from

    def _spoiled(self) -> None:
        for request in self._open:
            _fail(request, self._verdict(request.data))

    def _take(self, frames: Callable[..., list[Any]], *data: bytes) -> None:
        try:
            for frame in frames(*data):
                for request in self._open:
                    if request.future.done():
                        continue
                    try:
                        answer = request.answers(frame)
                    except DeviceError as error:
                        _fail(request, error)
                        break
                    if answer is not None:
                        self._answer(request, frame, answer)
                        break
                else:
                    self._stray_frame(frame)
        except Garbled as error:
            self._broken = error
            for request in self._open:
                _fail(request, error)

    def lost(self, error: LineDown) -> None:
        """Ends all outstanding requests, because the port was lost."""
        self._channel.lost_by = error
        if self._late is not None:
            self._late.wake()
        for request in self._open:
            _fail(request, error)

    async def settle(self, guard: float, gap: float) -> Settled:
        """Sends nothing until this transaction can no longer disturb the next.

        After a time-out: until the late reply has arrived, or for `guard` seconds. After noise:
        until `gap` seconds have passed without a byte, at most `guard`.
        """
        self._late = self._late or LateReply(self._channel)
        return await self._late.settle(guard, gap)

    def _stray_frame(self, frame: Any) -> None:
        """Takes a frame that answers no open request."""
        if self._takes_late(frame):
            self._stray = self._stray or Evidence.SLOW
            return
        if self._refuses_otherwise(frame):
            return
        is_echo = self.may_echo and any(frame == request.frame for request in self._open)
        station = self._device.settings.driver.station
        number = _number(frame)
        old = bool(number) and all(_number(request.frame) != number for request in self._open)
        # A reply with an old number is repeated or late: it tells nothing of this station.
        foreign = not old and getattr(frame, "station", station) != station
        if self._stray is not Evidence.STATION:
            self._stray = Evidence.STATION if foreign else Evidence.SHAPE
        if not is_echo and self._may_be_reply(frame):
            self.traffic.strange = True
            if not foreign and not old:
                self.traffic.extra += 1
                self.traffic.contradicted |= self._contradicts(frame)
        if self._on_unmatched_frame is not None:
            self._on_unmatched_frame(self._device, frame, is_echo)

    def _refuses_otherwise(self, frame: Any) -> bool:
        """Ends the open request with an error reply that names another one.

        It is no extra reply: if it is that to another master, the own one still arrives."""
        driver = self._device.settings.driver
        waiting = [request for request in self._open if not request.future.done()]
        if len(waiting) != 1 or not isinstance(driver, LooseRefusals):
            return False
        if (error := driver.refusal_of_another(frame)) is None:
            return False
        _fail(waiting[0], error)
        return True

    def _may_be_reply(self, frame: Any) -> bool:
        """Returns False for a frame that the device sends by itself, such as an on-demand block."""
        driver = self._device.settings.driver
        return not isinstance(driver, UnnumberedReplies) or driver.is_reply(frame)

    def _contradicts(self, frame: Any) -> bool:
        """Returns True for another reply to the last request that was answered."""
        replied = self.traffic.replied
        return replied is not None and frame != replied[0] and answers_again(frame, replied)

    def _answer(self, request: _Request, frame: Any, answer: Any) -> None:
        """Ends a request that was answered, and learns of an echo."""
        echo = self._channel.echo
        if echo.before >= SHORTEST_REPLY:  # they are no frame any more
            self.traffic.extra += 1
        if not echo.strip and (echo.found is not False or request.data in self._heard):
            echo.learn(request.data, self._heard, request.reply)
        if answer is True:  # an acknowledgement; of these, some repeat the request
            request.equal = echo.absent_by_evidence and frame == request.frame
        else:
            echo.absent_at = self._channel.quiet_since
        request.heard = len(self._heard)
        beyond = request.heard - request.reply
        if beyond >= SHORTEST_COMMAND and self._stray is None:
            own = len(request.data) if request.data in self._heard else 0  # its echo
            self.traffic.strange |= beyond - own >= SHORTEST_COMMAND
        self._heard = b""
        traffic = self.traffic
        if traffic.replied is not None:
            traffic.before += (traffic.replied[0],)
        traffic.replied, traffic.contradicted = (frame, request.answers), False
        request.future.set_result(answer)

    def _takes_late(self, frame: Any) -> bool:
        """Returns True for the answer to a request that timed out, here or in an older one."""
        unanswered = self._channel.unanswered
        if self._late is not None and self._late.is_it(frame):
            if unanswered.requests:
                unanswered.forget(frame)
            return True
        return bool(unanswered.requests) and unanswered.take(frame, self._channel.quiet_since)

    def _expire(self) -> float:
        """Ends the requests that timed out. Returns the next time-out."""
        now, again = self._channel.now(), NEVER
        for request in self._open:
            if request.future.done():
                continue
            if request.until > now:
                again = min(again, request.until)
            else:
                self._late = LateReply(
                    self._channel, request.answers, takes_refusals=not self._needs_resync
                )
                self._channel.unanswered.timed_out(
                    self._device, request.frame, request.answers, request.sent
                )
                request.future.set_exception(self._verdict(request.data))
        return again

    def hasten(self, within: float) -> None:
        """Waits for replies `within` so many seconds only, in place of `reply_timeout`."""
        channel = self._channel
        for request in self._open:
            spoken = (2 * len(request.data) + request.reply) * channel.wire.character
            request.until = min(request.until, request.sent + spoken + within)
            channel.alarm.by(max(request.until, channel.now()))

    def _verdict(self, request: bytes) -> DeviceError:
        return verdict(request, self._heard, self._channel.echo.early, self._stray)


@cache  # `isinstance` with a protocol takes as long as the rest of a read
def _may_end_by_gap(codec: type[Codec[Any]]) -> bool:
    return hasattr(codec, "gap_timeout")


def _number(frame: Any) -> int:
    """Returns the number of a request or reply; 0: this protocol has none."""
    number: int = getattr(frame, "transaction", 0)
    return number


def _fail(request: _Request, error: Exception) -> None:
    if not request.future.done():
        request.future.set_exception(error)
