"""The echo of a two-wire adapter, on the side of a station: its own reply comes back.

Some replies of Modbus are equal to their requests, so an echo looks like the master that writes
the same value again. Replies of another form prove an echo when they return, and prove that there
is none when they do not. Where only equal frames are known, the station replies "busy" once: the
master repeats its request, and an echo returns the "busy".
"""

from collections import deque
from dataclasses import dataclass, field
from enum import Enum

_LATEST = 1.0  # seconds after its reply within which an echo arrives, as long as none came later
_OLDEST, _MOST_OLD = 10.0, 16  # seconds and replies for which a later echo is recognised
_EARLY = 0.5  # times the shortest known delay: a frame before that is no echo
_LOST = 1.5  # times the shortest known delay: an echo that did not arrive until then was lost
_MISSES = 3  # replies without an echo, in a row, until the adapter does not echo any more
_AGAIN, _MORE = 8, 8  # equal frames in a row until the station asks again; then so many times more


class Sort(Enum):
    """The origin of a frame that the station received."""

    REQUEST = "request"
    ECHO = "echo"
    DOUBTFUL = "doubtful"  # either; the reply "busy" shows it


@dataclass(slots=True)
class _Reply:
    """A reply whose echo may still arrive."""

    frame: bytes
    at: float
    proves: bool  # its form is that of no request


@dataclass(slots=True)
class Echo:
    """The belief about the echo of one wire. `told`: the setting in the file; None: learn it."""

    told: bool | None = None
    _known: bool | None = None
    _delay: float = 0.0  # the shortest one
    _latest: float = _LATEST
    _replies: list[_Reply] = field(default_factory=list)
    _old: deque[_Reply] = field(default_factory=lambda: deque(maxlen=_MOST_OLD))  # without an echo
    _misses: int = 0
    _equal: int = 0  # frames in a row that were equal to the reply before
    _limit: int = _AGAIN

    def pending(self, now: float) -> list[bytes]:
        """Returns the echoes that may arrive next."""
        self._forget(now)
        return [reply.frame for reply in (*self._old, *self._replies)]

    def sent(self, reply: bytes, now: float, *, proves: bool) -> None:
        """Notes a reply. `proves`: its form is that of no request."""
        if self.told is not False:
            self._replies.append(_Reply(reply, now, proves))

    def judge(self, frame: bytes, now: float) -> Sort:
        """Returns the origin of a frame."""
        self._forget(now)
        place = next((i for i, one in enumerate(self._replies) if one.frame == frame), None)
        if place is None:
            return self._late(frame, now)
        one = self._replies[place]
        if one.proves:
            self._known, self._delay = True, min(self._delay or 9.0, now - one.at)
        elif self.told is None and not self._known:
            return self._doubt(place)
        elif now - one.at < _EARLY * self._delay or self._older_may_arrive(place, now):
            return Sort.REQUEST
        self._misses = self._equal = 0
        del self._replies[: place + 1]
        return Sort.ECHO

    def _older_may_arrive(self, place: int, now: float) -> bool:
        """Returns True while the echo before this one may arrive: echoes keep their order."""
        return place > 0 and now - self._replies[place - 1].at < _LOST * self._delay

    def _late(self, frame: bytes, now: float) -> Sort:
        """Judges a frame that is equal to no reply of the last time: an echo may be slower."""
        old = next((one for one in self._old if one.frame == frame), None)
        if old is None:
            self._equal = 0
            return Sort.REQUEST
        if not old.proves:
            return self._doubt(0)
        self._known, self._delay, self._misses = True, now - old.at, 0
        self._latest = min(2 * self._delay, _OLDEST)
        self._replies[:0] = [one for one in self._old if one.at > old.at]  # these may still return
        self._old.clear()
        return Sort.ECHO

    def _doubt(self, place: int) -> Sort:
        """Judges a frame that is equal to a reply, where nothing has shown an echo.

        Echoes keep their order: while an older one may still arrive, the frame is a request.
        """
        self._equal += 1
        if self._known is False:
            if self._equal < self._limit:
                return Sort.REQUEST
            self._known, self._limit = None, self._limit * _MORE
        elif place:
            return Sort.REQUEST
        self._replies.clear()
        self._old.clear()
        return Sort.DOUBTFUL

    def _forget(self, now: float) -> None:
        """Drops the replies whose echo did not arrive."""
        while self._old and now - self._old[0].at > _OLDEST:
            self._old.popleft()
        while self._replies and now - self._replies[0].at > self._latest:
            one = self._replies.pop(0)
            if self.told is None:
                self._old.append(one)
            self._misses += 1
            if self._known and self._misses >= _MISSES:
                self._known, self._latest = None, _LATEST
            elif self._known:
                continue
            elif one.proves:
                self._known = False
