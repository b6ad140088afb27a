"""Reading the history file from any thread, run by run, in the order of time."""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from heapq import heappop, heappush
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from gateway.contract.past.timerange import LATEST, TimeRange
from gateway.errors import Busy, Damaged
from gateway.parts.history.answers.outcomes import Outcome, Ring
from gateway.parts.history.answers.recent import Identity, SortedRun
from gateway.parts.history.store.file import identity, is_damage, oldest, tags
from gateway.parts.history.store.index import Index
from gateway.parts.history.store.rows import StoredRow, checksum
from gateway.tags import Sample

_MOST_INDEXES = 100  # in memory, of 64 to 320 kB


class SampleSource(NamedTuple):
    """The samples of one tag in one run; none is earlier than `first`."""

    first: int
    samples: Callable[[], Iterable[Sample]]  # in the order of time


def in_order(parts: Iterable[SampleSource]) -> Iterator[Sample]:
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
            until = min(
                heap[0][0] if heap else LATEST + 1, coming[0][1].first if coming else LATEST + 1
            )
            _push(heap, number, (yield from _before(until, rest)))


def _before(until: int, rest: Iterator[Sample]) -> Generator[Sample, None, Iterator[Sample]]:
    """Yields samples of one part as long as no other part has an earlier one. Returns the rest."""
    for sample in rest:
        if sample.time >= until:
            return chain((sample,), rest)
        yield sample
    return iter(())


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
        self._indexes: dict[tuple[Identity | None, SortedRun], Index] = {}

    def tags(self, file: Identity | None) -> tuple[Mapping[str, int], bool]:
        """Returns the number of each tag in the file, and whether names are damaged. Raises
        `Damaged`."""
        with self._lock:
            known_of, known, last, lack = self._tags
        if known_of != file:
            known, last, lack = {}, 0, False
        with self._connection(file) as database, _translated():
            added, last, more_lack = tags(database, last)
        known, lack = {**known, **added} if added else known, lack or more_lack
        with self._lock:
            self._tags = file, known, last, lack
        return known, lack

    def index(self, file: Identity | None, run: SortedRun) -> Index:
        """Returns the index of a run. Raises `Damaged`."""
        with self._lock:
            known = self._indexes.get((file, run))
        if known is None:
            with self._connection(file) as database, _translated():
                rows = database.execute("SELECT places FROM run WHERE id = ?", (run.number,))
                known = Index(next(iter(rows), (None,))[0])
            with self._lock:
                if len(self._indexes) >= _MOST_INDEXES:
                    self._indexes.clear()
                self._indexes[file, run] = known
        return known

    def rows(
        self, file: Identity | None, run: SortedRun, numbers: Sequence[int]
    ) -> tuple[list[StoredRow], bool] | None:
        """Returns these samples of a run, by their numbers in it, and whether some are lost. None
        if the run was dropped. Raises `Damaged`."""
        first = run.number
        columns = "id, tag, time, value, kind, bad, sum"
        wanted = f"id BETWEEN {first + numbers[0]:d} AND {first + numbers[-1]:d}"
        if not isinstance(numbers, range):
            wanted = f"id IN ({','.join(str(first + n) for n in numbers)})"
        with self._connection(file) as database, _translated():
            found = database.execute(
                f"SELECT {columns} FROM sample WHERE {wanted} ORDER BY id"  # noqa: S608
            ).fetchall()
            if oldest(database) > first:
                return None
        sound = [row for row in found if checksum(row[:6]) == row[6]]
        return sound, len(sound) != len(numbers)

    def latest_before(self, file: Identity | None, run: SortedRun, time: int) -> int | None:
        """Returns the time of the last sample of any tag in a run before `time`. Raises
        `Damaged`."""
        with self._connection(file) as database, _translated():
            [(found,)] = database.execute(
                "SELECT max(time) FROM sample WHERE id >= ? AND id < ? AND time < ?",
                (run.number, run.end, time),
            )
            return found if isinstance(found, int) else None

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


@contextmanager
def _translated() -> Iterator[None]:
    """Translates the errors of a damaged file. SQLite quotes damaged text."""
    try:
        yield
    except sqlite3.Error as error:
        if is_damage(error) or not getattr(error, "sqlite_errorname", ""):
            raise Damaged(str(error)) from error
        raise
    except UnicodeDecodeError as error:
        raise Damaged(str(error)) from error
