"""Moves samples and outcomes from memory to the open history file, and drops the oldest there.

Both on the history thread: the size of the file and the age of its samples have limits.
"""

import shutil
import sqlite3
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from gateway.parts.history.answers.outcomes import Outcomes, Ring
from gateway.parts.history.answers.recent import Recent, Run, SortedRun
from gateway.parts.history.store.file import HistoryFile

_ROOM_OF_OUTCOME = 1024  # bytes in the file; of writes and alarms a tenth each
# Runs that may expire between two checks. Few, because the wall clock may be wrong for a while.
_MOST_EXPIRED = 2
_HOUR = 3600 * 10**9  # ns


def age(runs: Sequence[SortedRun], now: int, keep: int) -> int:
    """Returns the age of the oldest run in ns, by the times that were recorded after it.

    A step counts at most a tenth of `keep`, but up to an hour, in both directions. So a clock that
    is years ahead makes no sample older than that, and when it is set back, not even that remains.
    """
    times = [runs[0].last, *(time for run in runs[1:] for time in (run.first, run.last)), now]
    longest = max(keep // 10, _HOUR)
    return sum(max(-longest, min(longest, b - a)) for a, b in pairwise(times))


class Retention:
    """Drops the oldest runs from a file that is too large, and those that are too old."""

    def __init__(self, keep: float, max_size: int, recent: Recent, wall: Callable[[], int]) -> None:
        """`keep`: seconds; `max_size`: bytes; `wall`: ns since 1970."""
        self.size = 0  # bytes, as last measured
        self.free: int | None = None  # bytes of its disk, as last measured
        self._keep = int(keep * 1e9)
        self._max_size = max_size
        self._recent = recent
        self._wall = wall
        self._may_expire = _MOST_EXPIRED
        self._next_check = 0.0

    def most_outcomes(self, ring: Ring) -> int:
        """Outcomes of writes that the file keeps."""
        most = self._max_size // 10 // _ROOM_OF_OUTCOME
        return max(100, most // 10 if ring is Ring.REFUSED else most)

    @property
    def room(self) -> int:
        """Bytes that the file may still grow."""
        return max(0, self._max_size - self.size)

    def run_was_sorted(self) -> None:
        """Checks the age of the runs at the next call of `make_room`."""
        self._may_expire = _MOST_EXPIRED

    def make_room(self, file: HistoryFile) -> None:
        """Drops at most one run, so that new samples do not wait for long."""
        if file.log_size() > file.log_limit:
            file.empty_log()
            if file.log_size() > max(file.log_limit, self._max_size // 4):
                raise BlockingIOError(0, "another program reads the file and does not end")
        now = time.monotonic()
        if now >= self._next_check:
            self._next_check = now + min(10.0, self._keep / 1e9 / 20)
            self._may_expire = _MOST_EXPIRED
            file.shrink()
            self.free = shutil.disk_usage(file.path.parent).free
        self.size = file.size()
        if self.size > self._max_size:
            file.shrink()
        runs = self._recent.sorted_runs
        if runs and file.used() > self._max_size - 3 * file.log_limit:
            self._drop(file, runs[0])
        elif self._may_expire:
            self._may_expire -= 1
            now_by_wall = self._wall()
            oldest = runs[0].first if runs else self._recent.first or now_by_wall
            file.drop_writes(min(now_by_wall - self._keep, oldest))
            if runs and age(runs, now_by_wall, self._keep) > self._keep:
                self._drop(file, runs[0])

    def _drop(self, file: HistoryFile, dropped: SortedRun) -> None:
        self._recent.set_sorted(run for run in self._recent.sorted_runs if run is not dropped)
        file.drop(dropped)


BATCH_SIZE = 8192  # samples in one transaction


@dataclass(eq=False)
class Transfer:
    """Stores runs in the order of arrival, and writes the index of each once it is closed."""

    _recent: Recent
    _outcomes: Sequence[Outcomes]
    _retention: Retention
    _wall: Callable[[], int]  # ns since 1970
    stored: int = 0  # samples since the start
    _unsorted: list[Run] = field(default_factory=list)  # runs with a number in the file

    @property
    def waiting(self) -> int:
        """Samples that are not in the file."""
        return self._recent.waiting

    @property
    def is_unfinished(self) -> bool:
        return bool(self._recent.waiting or any(self._outcomes))

    def opened(self, file: HistoryFile) -> None:
        """Compares memory with the file, which may be another one than before."""
        end = file.next_number()
        self._recent.opened(file.identity, file.closed_runs(self._wall(), 0), file.extent, end)
        for outcomes in self._outcomes:
            outcomes.opened(file.identity, file.last_write(outcomes.ring))
        self._unsorted = [run for run in self._recent.runs() if run.number]
        begin = min((run.number for run in self._unsorted), default=end)
        self._recent.set_sorted(file.closed_runs(self._wall(), begin))

    def run(self, file: HistoryFile) -> None:
        """Stores everything that waits. Raises `sqlite3.Error` and `OSError`."""
        for outcomes in self._outcomes:
            self._store_outcomes(file, outcomes)
        self._recent.close_old()
        for run in self._recent.runs():
            self._store_samples(file, run)
            self._close_runs(file)
            self._retention.make_room(file)

    def _store_samples(self, file: HistoryFile, run: Run) -> None:
        while (count := len(run.samples)) > run.stored:
            if not run.number:
                run.number = file.next_number()
                self._unsorted.append(run)
                file.set_sync(full=True)  # no other run gets the number after a power cut
            end = min(count, run.stored + BATCH_SIZE)
            file.store(run.number + run.stored, run.samples[run.stored : end])
            self.stored += end - run.stored
            self._recent.stored(run, end)

    def _store_outcomes(self, file: HistoryFile, outcomes: Outcomes) -> None:
        if not outcomes:
            return
        ring = outcomes.ring
        waiting = outcomes.begin_storing(file.last_write(ring))
        try:
            last = file.store_writes(ring, waiting, self._retention.most_outcomes(ring))
        except sqlite3.Error:
            outcomes.not_stored()
            raise
        outcomes.are_stored(last)

    def _close_runs(self, file: HistoryFile) -> None:
        for run in list(self._unsorted):
            if run.dropped or (run.closed and run.stored == len(run.samples)):
                end = run.number + run.stored
                closed = file.close_run(run.number, end, self._wall())
                self._recent.sorted_on_disk(run, closed)
                self._unsorted.remove(run)
                self._retention.run_was_sorted()
