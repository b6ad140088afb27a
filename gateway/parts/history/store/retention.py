"""Limits the size of the history file and the age of its samples, on the history thread."""

import time
from collections.abc import Callable, Sequence
from itertools import pairwise

from gateway.parts.history.answers.outcomes import Ring
from gateway.parts.history.answers.recent import Recent, SortedRun
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
