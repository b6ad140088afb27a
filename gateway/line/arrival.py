"""The time when bytes arrived, although the event loop handles them late."""

import asyncio
import time
from collections.abc import Callable, Mapping

import structlog

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

PERIOD = 0.1  # seconds between two measurements: no stamp is newer by more than this
NEVER = float("inf")
JUMP = 0.5  # seconds between two measurements; a clock that is corrected slowly gains less
HELD = 1.5  # seconds; a loop that is later by this much was held with its process


class ArrivalClock:
    """A wall clock for samples: it stays behind while the event loop is late.

    Bytes that arrive while the loop stands still wait in the system. Nothing tells when they
    arrived. So all stamps are those of the last time when the loop was on time: a stamp may be too
    old by the time that the loop stood still, but it is never new for an old value.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        """`wall`: ns since 1970."""
        self._wall = wall
        self._ahead = 0  # ns, of the wall clock before the monotonic one
        self._due = NEVER  # the time of the next measurement
        self._behind = 0.0  # seconds, until that time
        self._released = -NEVER
        self._timer: asyncio.TimerHandle | None = None
        self._jumps = 0
        self._jump = (0.0, 0.0)  # the last one, and when, in seconds of the monotonic clock
        self._now: Callable[[], float] = lambda: 0.0

    def start(self) -> None:
        """Measures the running loop until `stop`."""
        loop = asyncio.get_running_loop()
        self._now = loop.time
        self._due = loop.time() + PERIOD
        self._ahead = self._wall() - time.monotonic_ns()
        self._timer = loop.call_at(self._due, self._measure, loop)

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._due, self._behind, self._timer = NEVER, 0.0, None

    def __call__(self) -> int:
        """Returns ns since 1970."""
        behind = self._now() - self._due
        if behind < self._behind:
            behind = self._behind
        return self._wall() - int(behind * 1e9)

    def document(self) -> Mapping[str, object]:
        """The status document: jumps of the wall clock since the start."""
        jump, at = self._jump
        ago = round(time.monotonic() - at, 1) if self._jumps else None
        return {"jumps": self._jumps, "last": round(jump, 1) if self._jumps else None, "ago": ago}

    def released(self) -> float:
        """Returns the time of the loop when it turned again after its process was held."""
        now = self._now()
        return now if now - self._due >= HELD else self._released

    def _measure(self, loop: asyncio.AbstractEventLoop) -> None:
        now = loop.time()
        # Bytes may be read only after this timer: they keep the stamp for one more period.
        self._behind = max(0.0, now - self._due)
        if self._behind >= HELD:
            self._released = now
            log.warning("gateway stood still", seconds=round(self._behind, 1))
        self._watch_wall()
        self._due = now + PERIOD
        self._timer = loop.call_at(self._due, self._measure, loop)

    def _watch_wall(self) -> None:
        """Logs a jump: time stamps before and after it do not belong together.

        The loop's own clock may be that of the beginning of its turn.
        """
        ahead = self._wall() - time.monotonic_ns()
        jump = (ahead - self._ahead) / 1e9
        if abs(jump) >= JUMP:
            self._jumps, self._jump = self._jumps + 1, (jump, time.monotonic())
            log.warning("clock jumped", seconds=round(jump, 1), effect="time stamps jump too")
        self._ahead = ahead
