"""The newest samples, in memory: what waits for the disk, and what the disk has not sorted yet.

Samples are collected in **runs**. A run is closed when it is long enough or old enough; its
samples are on disk within 100 ms of their arrival, in the order of arrival, and once it is closed
they are sorted by tag and time in one go. Until then questions are answered from here.
"""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.tags import Sample

MOST_RUNS = 8  # in memory; while the disk is away the oldest is dropped for the next


class Identity(NamedTuple):
    """Which file it is. A copy has the same mark, and a new file may get the inode of one that is
    gone: only both together are one file's own."""

    inode: int
    mark: bytes


class Extent(NamedTuple):
    """What there is of a run somewhere. Times are ns since 1970."""

    first: int  # the earliest and the latest sample
    last: int
    samples: int


_NOTHING = Extent(0, 0, 0)


class Shelved(NamedTuple):
    """A run that is sorted on disk. Times are ns since 1970."""

    number: int
    first: int  # the earliest and the latest sample in it
    last: int
    samples: int
    closed: int  # when it was sorted

    @property
    def extent(self) -> Extent:
        return Extent(self.first, self.last, self.samples)


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

    def begins_with(self, extent: Extent) -> bool:
        """Whether what a file has under this run's number is the beginning of this run: another
        file, or an older copy of it, may have another run there."""
        times = [sample.time for sample in self.samples[: extent.samples]]
        return bool(times) and Extent(min(times), max(times), len(times)) == extent

    def is_whole_in(self, extent: Extent) -> bool:
        return self.closed and len(self.samples) == extent.samples and self.begins_with(extent)


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
        self.file: Identity | None = None  # that has the shelf
        self.shelf: tuple[Shelved, ...] = ()  # in the order of recording
        self._longest = longest
        self._oldest = oldest
        self._clock = clock
        self._lock = threading.Lock()
        self._closed: list[Run] = []
        self._newest = Run(clock())  # there always is one for what comes next

    # -- event loop --

    def add(self, samples: Iterable[Sample]) -> None:
        """Samples of tags without `history` are passed over."""
        with self._lock:
            run = self._newest
            for sample in samples:
                tag = sample.tag
                if not tag.history:
                    continue
                if len(run.samples) >= self._longest:
                    run = self._begin()
                run.samples.append(sample)
                run.by_tag.setdefault(tag.key, []).append(sample)
                self.recorded += 1

    # -- any thread --

    def of(self, tag: str) -> tuple[Identity | None, tuple[Shelved, ...], list[list[Sample]]]:
        """The shelf and its file, and what is in memory of a tag, run by run."""
        with self._lock:
            newest = [list(run.by_tag[tag]) for run in self._runs if tag in run.by_tag]
            return self.file, self.shelf, newest

    @property
    def waiting(self) -> int:
        """Samples that are not on disk yet."""
        with self._lock:
            return sum(len(run.samples) - run.stored for run in self._runs)

    # -- the history thread --

    def close_old(self) -> None:
        with self._lock:
            run = self._newest
            if run.samples and self._clock() - run.started >= self._oldest:
                self._begin()

    def runs(self) -> list[Run]:
        """Oldest first."""
        with self._lock:
            return self._runs

    def stored(self, run: Run, upto: int) -> None:
        """The first `upto` samples of the run are on disk."""
        with self._lock:
            self._stored(run, upto)

    def sorted_on_disk(self, run: Run, shelved: Shelved | None) -> None:
        with self._lock:
            if shelved is not None:
                self.shelf += (shelved,)
            if run in self._closed:
                self._closed.remove(run)

    def reshelve(self, shelf: Iterable[Shelved]) -> None:
        """What is sorted on disk now, in the same file."""
        with self._lock:
            self.shelf = tuple(shelf)

    def opened(
        self, file: Identity, shelf: Iterable[Shelved], unsorted: Mapping[int, Extent]
    ) -> None:
        """What a file holds that was just opened: the one before, or another.

        A run in memory leaves if the file has the whole of it, sorted. If it has the beginning,
        unsorted, the rest waits for the disk; of all others everything does.
        """
        shelf = tuple(shelf)
        extents = {run.number: run.extent for run in shelf}
        runs = self.runs()
        gone = {run for run in runs if run.is_whole_in(extents.get(run.number, _NOTHING))}
        begun = {run for run in runs if run.begins_with(unsorted.get(run.number, _NOTHING))}
        with self._lock:
            self.file, self.shelf = file, shelf
            self._closed = [run for run in self._closed if run not in gone]
            for run in runs:
                if run in begun:
                    self._stored(run, unsorted[run.number].samples)
                elif run not in gone:
                    self._stored(run, 0)
                    run.number = 0

    @property
    def _runs(self) -> list[Run]:
        return [*self._closed, self._newest]

    def _stored(self, run: Run, upto: int) -> None:
        if run.dropped:
            self.lost -= upto - run.stored
        run.stored = upto

    def _begin(self) -> Run:
        self._newest.closed = True
        self._closed.append(self._newest)
        if len(self._closed) >= MOST_RUNS:
            oldest = self._closed.pop(0)
            oldest.dropped = True
            self.lost += len(oldest.samples) - oldest.stored
        self._newest = Run(self._clock())
        return self._newest
