"""A second station with the number of a device: it replies to the same requests."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from gateway.errors import DeviceError

Replied = tuple[Any, Callable[[Any], Any]]  # a reply, and what tells another reply to its request
KEPT, LAST = 16, 6  # requests
OTHERS = 4  # of those kept: a repeated reply may push aside the right one, which is new as well
FOR = 600.0  # seconds


def answers_again(frame: Any, replied: Replied) -> bool:
    """Returns True if the frame answers the request of this reply, too; an error reply may."""
    try:
        return replied[1](frame) is not None
    except DeviceError:
        return True


class Twins:
    """Learns of a second station from replies that answer the last request once more.

    A device server repeats replies that arrived before. A second master gets replies to its own
    requests. Only a second station answers most requests again, and says something else at times.
    Then a reply that came alone may be that of either.
    """

    __slots__ = ("_again", "_differed", "_known", "_last", "_recent")

    def __init__(self) -> None:
        self._last: Replied | None = None
        self._recent = deque[object](maxlen=KEPT)  # replies to the last requests
        # Of each request: not answered again, answered again, with a reply that had not arrived yet
        self._again = deque[int](maxlen=KEPT)
        self._differed = self._known = -FOR

    def asked(self) -> None:
        """Notes a request to the device."""
        self._again.append(0)

    def replied(self, last: Replied | None, before: Sequence[object] = ()) -> None:
        """Notes the last reply to it, and those before in the same transaction."""
        self._recent += before
        if last is not None:
            self._recent.append(last[0])
        self._last = last

    def arrived(self, frame: Any, now: float) -> None:
        """Takes a frame that answers no open request."""
        if self._last is None or not self._again:
            return
        if answers_again(frame, self._last):
            self._again[-1] = max(self._again[-1], 1 if frame in self._recent else 2)
            if frame != self._last[0]:
                self._differed = now
            if self.exist(now) and self._again.count(2) >= OTHERS:
                self._known = now

    def exist(self, now: float) -> bool:
        """Returns True if two stations answer."""
        if now - self._differed >= FOR:
            return False
        # The right one may miss some requests. So half of the last few count as well.
        again = [answers > 0 for answers in self._again]
        return 2 * sum(again) >= len(again) or 2 * sum(again[-LAST:]) >= LAST

    def may_reply(self, now: float) -> bool:
        """Returns True if two stations certainly answered in the last ten minutes: what a reply
        says may be true of the other one only."""
        return now - self._known < FOR
