"""Moves samples and outcomes from memory to the open history file, on the history thread."""

import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from gateway.parts.history.answers.outcomes import Outcomes
from gateway.parts.history.answers.recent import Recent, Run
from gateway.parts.history.store.file import HistoryFile
from gateway.parts.history.store.retention import Retention

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
