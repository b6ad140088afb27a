"""The newest samples, in memory: until they are on disk, and until they are sorted there.

Samples are collected in **runs**. A run is closed when it is long enough or old enough. Its
samples are on disk within 100 ms of their arrival, in the order of arrival; once it is closed they
are sorted by tag and time in one transaction. Until then queries are answered from memory.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.tags import Sample

MOST_RUNS = 8  # in memory; while the disk fails, the oldest is dropped for a new one
ELEMENTS = 2  # of an array: they take about as much room as a sample


class Identity(NamedTuple):
    """The identity of one file. A copy has the same mark, and a new file may get the inode of a
    deleted one: only both together identify a file."""

    inode: int
    mark: bytes


class Extent(NamedTuple):
    """The part of a run that is stored somewhere. Times are ns since 1970."""

    first: int  # the earliest and the latest sample
    last: int
    samples: int


class SortedRun(NamedTuple):
    """A run with an index on disk. Times are ns since 1970."""

    number: int  # of its first sample
    first: int  # the earliest and the latest time in it
    last: int
    samples: int
    closed: int  # when its index was written

    @property
    def end(self) -> int:
        """The number after that of its last sample."""
        return self.number + self.samples

    @property
    def extent(self) -> Extent:
        return Extent(self.first, self.last, self.samples)


@dataclass(slots=True, eq=False)
class Run:
    """Samples in the order of arrival. The event loop appends; the history thread does the rest."""

    started: float  # seconds of the monotonic clock
    longest: int  # samples; fewer with arrays
    samples: list[Sample] = field(default_factory=list)
    by_tag: dict[str, list[Sample]] = field(default_factory=dict)
    closed: bool = False  # no sample is added any more
    dropped: bool = False  # because too many runs waited
    number: int = 0  # of its first sample on disk; 0 while none of it is there
    stored: int = 0  # of the samples, on disk

    def begins_with(self, extent: Extent) -> bool:
        """True if `extent`, found in a file under this run's number, is the beginning of this run:
        another file, or an older copy, may hold another run with that number."""
        times = [sample.time for sample in self.samples[: extent.samples]]
        return bool(times) and Extent(min(times), max(times), len(times)) == extent

    def is_whole_in(self, extent: Extent) -> bool:
        return self.closed and len(self.samples) == extent.samples and self.begins_with(extent)


class Content(NamedTuple):
    """The runs at one moment. Lists of samples grow at the end: the count says how many belong."""

    file: Identity | None  # of the sorted runs
    sorted_runs: tuple[SortedRun, ...]
    newest: list[tuple[int, list[Sample], int]]  # number or 0, samples, their count


class Recent:
    """The runs in memory, and the list of the runs that are sorted on disk.

    Bounded. Every method holds the lock for a moment only, never while the disk is busy. A run is
    either in memory or in the list, so that a query sees each sample once.
    """

    def __init__(
        self, longest: int, oldest: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """A run has at most `longest` samples and stays open for `oldest` seconds."""
        self.recorded = 0
        self.lost = 0
        self.latest = 0  # the time of the last sample, of any tag
        self.file: Identity | None = None  # the file with the sorted runs
        self.sorted_runs: tuple[SortedRun, ...] = ()  # in the order of recording
        self._longest = longest
        self._oldest = oldest
        self._clock = clock
        self._lock = threading.Lock()
        self._closed: list[Run] = []
        self._newest = Run(clock(), longest)  # always open for the next sample

    # -- event loop --

    def add(self, samples: Iterable[Sample]) -> None:
        """Adds the samples of tags with `history`."""
        with self._lock:
            run = self._newest
            for sample in samples:
                tag = sample.tag
                if not tag.publishing.history:
                    continue
                if len(run.samples) >= run.longest:
                    run = self._begin()
                if tag.layout.type.count:
                    run.longest -= tag.layout.type.count // ELEMENTS
                run.samples.append(sample)
                run.by_tag.setdefault(tag.recorded_key, []).append(sample)
                self.recorded += 1
                self.latest = sample.time

    # -- any thread --

    def find(self, tag: str) -> tuple[Identity | None, tuple[SortedRun, ...], list[list[Sample]]]:
        """Returns the sorted runs and their file, and the samples of a tag in memory, by run."""
        with self._lock:
            newest = [list(run.by_tag[tag]) for run in self._runs if tag in run.by_tag]
            return self.file, self.sorted_runs, newest

    def content(self) -> "Content":
        """Returns everything that is recorded at this moment."""
        with self._lock:
            return Content(
                self.file,
                self.sorted_runs,
                [
                    # Nothing is on disk yet: another run may get the number after a crash.
                    (run.number if run.stored else 0, run.samples, len(run.samples))
                    for run in self._runs
                ],
            )

    def latest_before(self, time: int) -> int:
        """Returns the time of the newest sample in memory before `time`, of any tag; 0: none."""
        with self._lock:
            if self.latest < time:
                return self.latest
            for run in reversed(self._runs):
                if run.samples and run.samples[0].time < time:
                    return next(s.time for s in reversed(run.samples) if s.time < time)
        return 0

    @property
    def first(self) -> int | None:
        """The time of the first sample in memory."""
        with self._lock:
            return next((run.samples[0].time for run in self._runs if run.samples), None)

    @property
    def waiting(self) -> int:
        """Samples that are not on disk yet."""
        with self._lock:
            return sum(len(run.samples) - run.stored for run in self._runs)

    @property
    def waiting_since(self) -> int | None:
        """The time of the first sample that is not on disk yet, in ns since 1970."""
        with self._lock:
            for run in self._runs:
                if run.stored < len(run.samples):
                    return run.samples[run.stored].time
        return None

    # -- the history thread --

    def close_old(self) -> None:
        with self._lock:
            run = self._newest
            if run.samples and self._clock() - run.started >= self._oldest:
                self._begin()

    def runs(self) -> list[Run]:
        """The runs in memory, oldest first."""
        with self._lock:
            return self._runs

    def stored(self, run: Run, count: int) -> None:
        """The first `count` samples of the run are on disk."""
        with self._lock:
            self._stored(run, count)

    def sorted_on_disk(self, run: Run, result: SortedRun | None) -> None:
        with self._lock:
            if result is not None:
                self.sorted_runs += (result,)
            if run in self._closed:
                self._closed.remove(run)

    def set_sorted(self, runs: Iterable[SortedRun]) -> None:
        """Replaces the list of sorted runs of the same file."""
        with self._lock:
            self.sorted_runs = tuple(runs)

    def opened(
        self,
        file: Identity,
        runs: Iterable[SortedRun],
        extent: Callable[[int, int], Extent],
        end: int,
    ) -> None:
        """Compares the runs in memory with a file that was just opened: the same or another.

        `extent`: of so many samples of the file from a number on; `end`: the number after the last.
        A run leaves memory if the file has the whole of it, with its index. If the file ends with
        its beginning, the rest is stored next. Every other run is stored from its beginning.
        """
        extents = {run.number: run.extent for run in runs}
        begun, whole = dict[Run, Extent](), set[Run]()
        for run in self.runs():
            there = extent(run.number, len(run.samples)) if run.number else None
            if there is not None and run.begins_with(there):
                if run.is_whole_in(there):
                    begun[run] = there
                    whole |= {run} if extents.get(run.number) == there else set()
                elif run.number + there.samples == end:
                    begun[run] = there
        with self._lock:
            self.file = file
            self._closed = [run for run in self._closed if run not in whole]
            for run in self._runs:
                if run in begun:
                    self._stored(run, begun[run].samples)
                else:
                    self._stored(run, 0)
                    run.number = 0

    @property
    def _runs(self) -> list[Run]:
        return [*self._closed, self._newest]

    def _stored(self, run: Run, count: int) -> None:
        if run.dropped:
            self.lost -= count - run.stored
        run.stored = count

    def _begin(self) -> Run:
        self._newest.closed = True
        self._closed.append(self._newest)
        if len(self._closed) >= MOST_RUNS:
            oldest = self._closed.pop(0)
            oldest.dropped = True
            self.lost += len(oldest.samples) - oldest.stored
        self._newest = Run(self._clock(), self._longest)
        return self._newest
