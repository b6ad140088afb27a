"""A request that timed out: what was heard in place of its reply, and the reply that comes late."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gateway.engine.jobs.jobs import Settled
from gateway.errors import DeviceError, Evidence, Garbled, NoReply
from gateway.line.channel import Channel

MOST_WAITS = 100  # in one transaction


def verdict(request: bytes, heard: bytes, early: bytes, stray: Evidence | None) -> DeviceError:
    """Returns the end of a request without a reply. `heard`: since it was sent; `early`: in place
    of its echo; `stray`: what other frames were."""
    heard = heard or early
    if not heard:
        return NoReply("no reply")
    if early:
        return Garbled("our own request did not come back", heard)
    if heard == request:
        return Garbled("heard only our own request", heard, evidence=Evidence.ECHO)
    if stray is Evidence.STATION:
        return Garbled("another station spoke", heard, evidence=Evidence.STATION)
    if stray is Evidence.SLOW:
        return Garbled("only replies to older requests", heard, evidence=Evidence.SLOW)
    if stray is Evidence.SHAPE:
        return Garbled("no answer to this", heard, evidence=Evidence.SHAPE)
    return Garbled("no whole frame", heard, evidence=Evidence.NOISE)


@dataclass(slots=True, eq=False)
class LateReply:
    """The reply that may still arrive, and the silence until then."""

    channel: Channel
    answers: Callable[[Any], Any] | None = None  # None: noise was heard, and no reply is awaited
    takes_refusals: bool = False  # an error reply names no request: it may be the late one
    arrived: bool = False
    waits: int = 0
    _awaited: "asyncio.Future[None] | None" = None

    def is_it(self, frame: Any) -> bool:
        """Returns True for the late reply, once."""
        if self.arrived or self.answers is None:
            return False
        try:
            self.arrived = self.answers(frame) is not None
        except DeviceError:
            self.arrived = self.takes_refusals
        if self.arrived:
            self.wake()
        return self.arrived

    def wake(self) -> None:
        """Ends the waiting."""
        if self._awaited is not None and not self._awaited.done():
            self._awaited.set_result(None)

    async def settle(self, guard: float, gap: float) -> Settled:
        """Waits until the late reply has arrived, or for `guard` seconds.

        After noise: until `gap` seconds have passed without a byte, at most `guard`. Raises
        `LineDown` if the port is lost then.
        """
        channel, start = self.channel, self.channel.now()
        until = start + guard
        self.waits += 1
        if self.waits > MOST_WAITS:  # without time, all lines would stand still
            raise RuntimeError("the line waits for quiet without end")
        while self.answers is None and channel.lost_by is None:
            quiet = channel.quiet_since + gap
            if min(quiet, until) <= channel.now():
                return Settled(late=None, quiet=quiet <= channel.now())
            await self._wait(min(quiet, until))
        if self.answers is None and channel.lost_by is not None:
            raise channel.lost_by
        if self.arrived:
            return Settled(late=0.0)
        if channel.lost_by is None:
            await self._wait(until)
        return Settled(channel.now() - start if self.arrived else None)

    async def _wait(self, end: float) -> None:
        """Waits until the late reply has arrived, the port is lost, or `end`."""
        loop = self.channel.loop
        self._awaited = loop.create_future()
        timer = loop.call_at(end, self.wake)
        try:
            await self._awaited
        finally:
            timer.cancel()
