"""Numbered requests that timed out: their answers can arrive in later transactions.

A bridge to serial units asks one unit at a time, with a time-out of its own. While it waits for a
dead unit, requests to the others wait in the bridge.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.errors import DeviceError

FIRST_WAIT, LONGEST_WAIT = 3.0, 10.0  # seconds of a bridge for a dead unit: expected, at most
MARGIN = 1.2  # of a measured wait
SEEN_FOR = 3600.0  # seconds after which a shorter wait takes the place of the longest one
MOST_KEPT, KEPT = 64, 60.0  # requests, seconds


@dataclass(slots=True, eq=False)
class TimedOut:
    """A request without a reply. Times by the line's clock."""

    device: Device
    number: int
    answers: Callable[[Any], Any]
    sent: float
    holds_up: bool = True  # False after the answer to a later request

    def release(self) -> None:
        """Notes that a later request was answered."""
        self.holds_up = False


class Unanswered:
    """The timed-out requests of one line, and the time for which they hold up others."""

    def __init__(self) -> None:
        self.requests: deque[TimedOut] = deque(maxlen=MOST_KEPT)
        self.longest = 0.0  # seconds for which a request was seen to hold up others
        self._seen_at = 0.0

    def timed_out(
        self, device: Device, request: Any, answers: Callable[[Any], Any], sent: float
    ) -> None:
        """Notes a request whose time is over. Without a number its reply settles the line."""
        if number := getattr(request, "transaction", 0):
            self.requests.append(TimedOut(device, number, answers, sent))

    def held_up_until(self, device: Device) -> float:
        """Returns the time until which requests to other devices can hold up one to `device`.

        A device that failed already gets no longer wait: perhaps nothing answers at all.
        """
        if device.health.state is not State.ONLINE:
            return 0.0
        wait = min(max(FIRST_WAIT, MARGIN * self.longest), LONGEST_WAIT)
        others = (each for each in self._holding if each.device is not device)
        return max((each.sent + wait for each in others), default=0.0)

    def answered(self, sent: float, now: float) -> None:
        """Notes the answer to the request of time `sent`. Older ones no longer hold up others."""
        while self.requests and self.requests[0].sent < now - KEPT:
            self.requests.popleft()
        older = [each for each in self._holding if each.sent < sent]
        self._measure(older, now)
        for each in older:
            each.release()

    def take(self, frame: Any, now: float) -> bool:
        """Returns True if the frame is the late answer to one of the requests."""
        found = next((each for each in self.requests if _answers(each, frame)), None)
        if found is None:
            return False
        self._measure(self._holding, now)
        self.requests.remove(found)
        device = found.device
        device.record.count_late()
        if device.state is not State.ONLINE and not _is_error(found, frame):
            timeout = device.timing.reply_timeout
            device.health.replied_late(now - found.sent, timeout, now, last=False)
            device.health.probes.soon()
        return True

    def forget(self, frame: Any) -> None:
        """Forgets the request whose late answer ended its own transaction."""
        found = next((each for each in self.requests if _answers(each, frame)), None)
        if found is not None:
            self.requests.remove(found)

    @property
    def _holding(self) -> list[TimedOut]:
        return [each for each in self.requests if each.holds_up]

    def _measure(self, holding: list[TimedOut], now: float) -> None:
        if holding:
            seen = now - min(each.sent for each in holding)
            if seen >= self.longest or now - self._seen_at >= SEEN_FOR:
                self.longest, self._seen_at = min(seen, LONGEST_WAIT), now


def _answers(request: TimedOut, frame: Any) -> bool:
    if getattr(frame, "transaction", 0) != request.number:
        return False
    try:
        return request.answers(frame) is not None
    except DeviceError:
        return True


def _is_error(request: TimedOut, frame: Any) -> bool:
    try:
        request.answers(frame)
    except DeviceError:
        return True
    return False
