"""Outcomes of writes, and changes of alarms, that wait for the disk; queries already find them.

Refusals of the gateway itself come as fast as a client can send. They have a ring of their own, so
that they push out no write that a device may have executed.
"""

import threading
from collections import deque
from enum import StrEnum
from typing import NamedTuple

from gateway.contract.past.timerange import TimeRange
from gateway.parts.history.answers.recent import Identity

MOST_WAITING = 10_000


class Ring(StrEnum):
    """The tables of outcomes in the file."""

    WRITTEN = "written"  # a device executed it, or may have
    REFUSED = "refused"  # nothing was sent
    ALARMS = "alarms"  # a change of an alarm


class Outcome(NamedTuple):
    """One outcome, as on the `writes` key."""

    time: int  # ns since 1970
    text: str  # JSON


class Pending(NamedTuple):
    """The outcomes in memory at one moment, and the limit that separates them from the file's."""

    file: Identity | None  # the file with the other outcomes
    last: int  # the number of the last of them
    outcomes: list[Outcome]  # by time


class Outcomes:
    """The outcomes of one ring. Bounded. Every method holds the lock for a moment only, never while
    the disk is busy."""

    def __init__(self, ring: Ring) -> None:
        self.ring = ring
        self.stored = 0  # since the start
        self.lost = 0  # because too many waited
        self._waiting: deque[Outcome] = deque()
        self._storing: list[Outcome] = []
        self._file: Identity | None = None
        self._last = 0
        self._lock = threading.Lock()

    # -- any thread --

    def add(self, time: int, text: str) -> None:
        with self._lock:
            if len(self._waiting) >= MOST_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(Outcome(time, text))

    def pending(self, period: TimeRange) -> Pending:
        with self._lock:
            file, last, found = self._file, self._last, [*self._storing, *self._waiting]
        first, latest = period
        in_range = [outcome for outcome in found if first <= outcome.time <= latest]
        return Pending(file, last, sorted(in_range, key=lambda outcome: outcome.time))

    def __len__(self) -> int:
        with self._lock:
            return len(self._storing) + len(self._waiting)

    # -- the history thread --

    def opened(self, file: Identity, last: int) -> None:
        """Notes the open file; its last outcome has number `last`."""
        with self._lock:
            self._file, self._last = file, last

    def begin_storing(self, last: int) -> list[Outcome]:
        """Returns the outcomes to store now, after number `last` in the file."""
        with self._lock:
            self._last = last
            self._storing = list(self._waiting)
            self._waiting.clear()
            return self._storing

    def are_stored(self, last: int) -> None:
        """The outcomes of `begin_storing` are in the file, the last with number `last`."""
        with self._lock:
            self._last = last
            self.stored += len(self._storing)
            self._storing = []

    def not_stored(self) -> None:
        """The outcomes of `begin_storing` are not in the file: they wait again, as the first."""
        with self._lock:
            self._waiting.extendleft(reversed(self._storing))
            self._storing = []
