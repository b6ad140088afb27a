"""The newest samples, in memory: what waits for the disk, and what the disk has not sorted yet.

Samples are collected in **runs**. A run is closed when it is long enough or old enough; its
samples are on disk within 100 ms of their arrival, in the order of arrival, and once it is closed
they are sorted by tag and time in one go. Until then questions are answered from here.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.tags import Sample

MOST_RUNS = 8  # in memory; while the disk is away the oldest is dropped for the next


class Shelved(NamedTuple):
    """A run that is sorted on disk. Times are ns since 1970."""

    number: int
    first: int  # the earliest and the latest sample in it
    last: int
    samples: int
    closed: int  # when it was sorted


@dataclass(slots=True, eq=False)
class Run:
    """Samples in the order of arrival. The event loop appends; the rest is the writer's."""

    started: float  # seconds of the monotonic clock
    samples: list[Sample] = field(default_factory=list)
    by_tag: dict[str, list[Sample]] = field(default_factory=dict)
    closed: bool = False  # nothing is added any more
    dropped: bool = False  # for want of room
    number: int = 0  # on disk; 0 while nothing of it is there
    stored: int = 0  # of the samples, on disk


class Recent:
    """The runs in memory, and the list of those that are sorted on disk.

    Bounded; every method takes the lock for a moment only, never while the disk is busy. A run is
    either in memory or on the shelf, so that a question sees each sample once.
    """

    def __init__(
        self, longest: int, oldest: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """A run has at most `longest` samples and stays open for `oldest` seconds."""
        self.recorded = 0
        self.lost = 0
        self.shelf: tuple[Shelved, ...] = ()  # in the order of recording
        self._longest = longest
        self._oldest = oldest
        self._clock = clock
        self._lock = threading.Lock()
        self._runs = [Run(clock())]

    # -- event loop --

    def add(self, samples: Iterable[Sample]) -> None:
        """Samples of tags without `history` are passed over."""
        with self._lock:
            run = self._runs[-1]
            for sample in samples:
                tag = sample.tag
                if not tag.history:
                    continue
                if len(run.samples) >= self._longest:
                    run = self._open()
                run.samples.append(sample)
                run.by_tag.setdefault(tag.key, []).append(sample)
                self.recorded += 1

    # -- any thread --

    def of(self, tag: str) -> tuple[tuple[Shelved, ...], list[list[Sample]]]:
        """The shelf, and what is in memory of a tag, run by run."""
        with self._lock:
            return self.shelf, [list(run.by_tag[tag]) for run in self._runs if tag in run.by_tag]

    @property
    def waiting(self) -> int:
        """Samples that are not on disk yet."""
        with self._lock:
            return sum(len(run.samples) - run.stored for run in self._runs)

    # -- the history thread --

    def close_old(self) -> None:
        with self._lock:
            run = self._runs[-1]
            if run.samples and self._clock() - run.started >= self._oldest:
                self._open()

    def runs(self) -> list[Run]:
        """Oldest first."""
        with self._lock:
            return list(self._runs)

    def stored(self, run: Run, upto: int) -> None:
        """The first `upto` samples of the run are on disk."""
        with self._lock:
            if run.dropped:
                self.lost -= upto - run.stored
            run.stored = upto

    def sorted_on_disk(self, run: Run, shelved: Shelved | None) -> None:
        with self._lock:
            if shelved is not None:
                self.shelf += (shelved,)
            if run in self._runs:
                self._runs.remove(run)

    def reshelve(self, shelf: Iterable[Shelved]) -> None:
        """What is sorted on disk now. Runs in memory that are there already leave."""
        with self._lock:
            self.shelf = tuple(shelf)
            there = {shelved.number for shelved in self.shelf}
            self._runs = [run for run in self._runs if run.number not in there]

    def _open(self) -> Run:
        self._runs[-1].closed = True
        self._runs.append(Run(self._clock()))
        if len(self._runs) > MOST_RUNS:
            oldest = self._runs.pop(0)
            oldest.dropped = True
            self.lost += len(oldest.samples) - oldest.stored
        return self._runs[-1]
