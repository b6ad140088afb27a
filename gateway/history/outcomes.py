"""Outcomes of writes on their way to the disk, where a question finds them all the same."""

import threading
from collections import deque
from typing import NamedTuple

from gateway.history.recent import Identity
from gateway.history.timerange import TimeRange

MOST_WAITING = 10_000


class Outcome(NamedTuple):
    """As on the `writes` key."""

    time: int  # ns since 1970
    told: str  # JSON


class Pending(NamedTuple):
    """What is not on disk at one moment, and how to find the rest: nothing is in both."""

    file: Identity | None  # where the others are
    last: int  # the number of the last of them
    outcomes: list[Outcome]  # by time


class Outcomes:
    """Bounded; every method takes the lock for a moment only, never while the disk is busy."""

    def __init__(self) -> None:
        self.stored = 0  # since the start
        self.lost = 0  # for want of room
        self._waiting: deque[Outcome] = deque()
        self._storing: list[Outcome] = []
        self._file: Identity | None = None
        self._last = 0
        self._lock = threading.Lock()

    # -- any thread --

    def add(self, time: int, told: str) -> None:
        with self._lock:
            if len(self._waiting) >= MOST_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(Outcome(time, told))

    def pending(self, wanted: TimeRange) -> Pending:
        with self._lock:
            file, last, found = self._file, self._last, [*self._storing, *self._waiting]
        first, latest = wanted
        asked = [outcome for outcome in found if first <= outcome.time <= latest]
        return Pending(file, last, sorted(asked, key=lambda outcome: outcome.time))

    def __len__(self) -> int:
        with self._lock:
            return len(self._storing) + len(self._waiting)

    # -- the history thread --

    def opened(self, file: Identity, last: int) -> None:
        """A file whose last outcome has this number."""
        with self._lock:
            self._file, self._last = file, last

    def begin(self, last: int) -> list[Outcome]:
        """What is to be stored now, behind the last one in the file."""
        with self._lock:
            self._last = last
            self._storing = list(self._waiting)
            self._waiting.clear()
            return self._storing

    def done(self, last: int) -> None:
        """What was begun is on disk, the last of it with this number."""
        with self._lock:
            self._last = last
            self.stored += len(self._storing)
            self._storing = []

    def undone(self) -> None:
        """What was begun is not on disk: it is stored before what came meanwhile."""
        with self._lock:
            self._waiting.extendleft(reversed(self._storing))
            self._storing = []
