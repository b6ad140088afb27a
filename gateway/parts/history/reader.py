"""Reading the history file from any thread, run by run, in the order of time."""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from heapq import heappop, heappush
from pathlib import Path
from typing import NamedTuple

from gateway.contract.timerange import TimeRange
from gateway.errors import Busy
from gateway.parts.history import sections
from gateway.parts.history.file import identity
from gateway.parts.history.outcomes import Outcome, Ring
from gateway.parts.history.recent import Identity, SortedRun
from gateway.parts.history.sections import FullRow, Section
from gateway.tags import Sample

_MOST_LISTS = 400  # lists of sections in memory, of 50 kB


class Part(NamedTuple):
    """The samples of one tag in one run; none is earlier than `first`."""

    first: int
    samples: Callable[[], Iterable[Sample]]  # in the order of time


def in_order(parts: Iterable[Part]) -> Iterator[Sample]:
    """Merges parts by time; samples of equal time in the order of the parts.

    Starts a part only when the merge reaches its first time. So several parts are open at once
    only if they overlap (after the clock was set back).
    """
    coming = deque(sorted(enumerate(parts), key=lambda numbered: numbered[1].first))
    heap: list[tuple[int, int, Sample, Iterator[Sample]]] = []
    while coming or heap:
        while coming and (not heap or coming[0][1].first <= heap[0][0]):
            number, part = coming.popleft()
            _push(heap, number, iter(part.samples()))
        if heap:
            _, number, sample, rest = heappop(heap)
            yield sample
            _push(heap, number, rest)


def _push(
    heap: list[tuple[int, int, Sample, Iterator[Sample]]], number: int, rest: Iterator[Sample]
) -> None:
    for sample in rest:
        heappush(heap, (sample.time, number, sample, rest))
        return


class Reader:
    """Read-only connections. A query holds one for one run at a time: a longer read would keep
    SQLite from emptying its log.

    Runs and tags have different numbers in every file, so each query names its file. Raises
    `sqlite3.Error`, `OSError`, and `Busy` if another file is in its place now.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._idle: list[sqlite3.Connection] = []
        self._generation = 0  # connections of an older one are not used again
        # Of a file: its tags, the highest number, whether names are damaged.
        self._tags: tuple[Identity | None, dict[str, int], int, bool] = (None, {}, 0, False)
        self._sections: dict[tuple[Identity | None, SortedRun], list[Section]] = {}

    def tags(self, file: Identity | None) -> tuple[Mapping[str, int], bool]:
        """Returns the number of each tag in the file, and whether names are damaged. Raises
        `Damaged`."""
        with self._lock:
            known_of, known, last, lack = self._tags
        if known_of != file:
            known, last, lack = {}, 0, False
        with self._connection(file) as database:
            added, last, more_lack = sections.tags(database, last)
        known, lack = {**known, **added} if added else known, lack or more_lack
        with self._lock:
            self._tags = file, known, last, lack
        return known, lack

    def sections(self, file: Identity | None, run: SortedRun) -> list[Section]:
        """Returns the sections of a run. Raises `Damaged`."""
        with self._lock:
            known = self._sections.get((file, run))
        if known is None:
            known = self.listed(file, run)
            with self._lock:
                if len(self._sections) >= _MOST_LISTS:
                    self._sections.clear()
                self._sections[file, run] = known
        return known

    def listed(self, file: Identity | None, run: SortedRun) -> list[Section]:
        """Returns the sections of a run as they are on disk now. Raises `Damaged`."""
        with self._connection(file) as database:
            return sections.read(database, run.number)

    def rows(
        self, file: Identity | None, run: SortedRun, group: Sequence[Section]
    ) -> list[FullRow] | None:
        """Returns the rows of neighbouring sections. None if the run was dropped. Raises
        `Damaged`."""
        with self._connection(file) as database:
            # A dropped run leaves its number to another one, with another time.
            is_same = database.execute(
                "SELECT 1 FROM run WHERE run = ? AND closed = ?", (run.number, run.closed)
            )
            return sections.rows(database, run.number, group) if is_same.fetchall() else None

    def neighbour(
        self, file: Identity | None, last_run: int, tag: int, time: int, *, later: bool
    ) -> tuple[int, int] | None:
        """Returns the run and the time of the last sample of a tag before `time`, or of the first
        one after it, in the runs up to `last_run`. Raises `Damaged`."""
        with self._connection(file) as database:
            return sections.neighbour(database, last_run, tag, time, later=later)

    def latest_before(self, file: Identity | None, run: SortedRun, time: int) -> int | None:
        """Returns the time of the last sample of any tag in a run before `time`. Raises
        `Damaged`."""
        with self._connection(file) as database:
            return sections.latest_before(database, run.number, time)

    def writes(
        self, ring: Ring, file: Identity | None, last: int, period: TimeRange
    ) -> Iterator[Outcome]:
        """Yields outcomes of writes of a ring in the order of time, up to number `last`."""
        after = (period.first, -1)
        begun = False
        while True:
            with self._connection(file) as database:
                rows = database.execute(
                    f"SELECT time, id, outcome FROM {ring} WHERE (time, id) > (?, ?)"  # noqa: S608
                    " AND time <= ? AND id <= ? ORDER BY time, id LIMIT 1000",
                    (*after, period.last, last),
                ).fetchall()
                is_there = database.execute(
                    f"SELECT 1 FROM {ring} WHERE id = ?",  # noqa: S608  (our own name)
                    after[1:],
                ).fetchall()
            if begun and not is_there:  # perhaps later ones were dropped too
                raise Busy("the next outcomes were dropped meanwhile: ask again")
            begun = True
            if not rows:
                return
            yield from (Outcome(time, text) for time, _, text in rows)
            after = rows[-1][:2]

    def renew(self) -> None:
        """Closes idle connections: the path may name another file now, or none."""
        with self._lock:
            self._generation += 1
            idle, self._idle = self._idle, []
        for database in idle:
            database.close()

    @contextmanager
    def _connection(self, file: Identity | None) -> Iterator[sqlite3.Connection]:
        with self._lock:
            generation = self._generation
            database = self._idle.pop() if self._idle else None
        if database is None:
            database = sqlite3.connect(
                f"{self._path.absolute().as_uri()}?mode=ro", uri=True, check_same_thread=False
            )
        with ExitStack() as undo:
            undo.callback(database.close)
            database.execute("BEGIN")  # one state of the file for all statements
            if identity(database, self._path) != file:
                raise Busy("history cannot be read: another file has taken its place")
            yield database
            database.execute("COMMIT")
            undo.pop_all()
        with self._lock:
            if generation == self._generation:
                self._idle.append(database)
                return
        database.close()
