"""Reading the history file from any thread, run by run, in the order of time."""

import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from heapq import heappop, heappush
from pathlib import Path
from typing import NamedTuple

from gateway.errors import Busy
from gateway.history.file import identity
from gateway.history.outcomes import Outcome
from gateway.history.recent import Identity, Shelved
from gateway.history.rows import from_row
from gateway.history.timerange import TimeRange
from gateway.tags import Sample, Tag


class Part(NamedTuple):
    """Samples of one tag and one run; none is earlier than `first`."""

    first: int
    samples: Callable[[], Iterable[Sample]]  # in the order of time


def in_order(parts: Iterable[Part]) -> Iterator[Sample]:
    """Merges parts by time; samples of equal time in the order of the parts.

    A part is begun when its time has come, so that only those are open at once which overlap
    (after the clock was set back).
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
    """Connections that only read. No question holds one for longer than one run takes: a long
    read would keep SQLite from emptying its log.

    Runs and tags have numbers of their own in every file, so each question says which file it
    means. Raises `sqlite3.Error`, `OSError`, and `Busy` where there is another file now.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._idle: list[sqlite3.Connection] = []
        self._age = 0  # of the file: connections to an older one are not used again

    def samples(
        self, file: Identity | None, tag: Tag, run: Shelved, wanted: TimeRange, limit: int | None
    ) -> list[Sample] | None:
        """The first of one run: all of them without a limit. None where the run is gone."""
        with self._connection(file) as database:
            rows = database.execute(
                "SELECT time, value, kind, bad FROM sample"
                " WHERE run = ? AND tag = (SELECT id FROM tag WHERE key = ?)"
                " AND time BETWEEN ? AND ? ORDER BY time, n LIMIT ?",
                (run.number, tag.key, *wanted, -1 if limit is None else limit),
            ).fetchall()
            # It goes with its samples, and its number is given to another one.
            there = database.execute(
                "SELECT 1 FROM run WHERE run = ? AND closed = ?", (run.number, run.closed)
            ).fetchall()
        return [from_row(tag, row) for row in rows] if there else None

    def writes(self, file: Identity | None, last: int, wanted: TimeRange) -> Iterator[Outcome]:
        """The outcomes of writes in the order of time; `last`: none with a higher number."""
        after = (wanted.first, -1)
        begun = False
        while True:
            with self._connection(file) as database:
                rows = database.execute(
                    "SELECT time, id, outcome FROM written WHERE (time, id) > (?, ?)"
                    " AND time <= ? AND id <= ? ORDER BY time, id LIMIT 1000",
                    (*after, wanted.last, last),
                ).fetchall()
                there = database.execute("SELECT 1 FROM written WHERE id = ?", after[1:]).fetchall()
            if begun and not there:  # nor perhaps those that came after it
                raise Busy("history has dropped meanwhile what was to come next: ask again")
            begun = True
            if not rows:
                return
            yield from (Outcome(time, told) for time, _, told in rows)
            after = rows[-1][:2]

    def renew(self) -> None:
        """The path names another file now, or none."""
        with self._lock:
            self._age += 1
            idle, self._idle = self._idle, []
        for database in idle:
            database.close()

    @contextmanager
    def _connection(self, file: Identity | None) -> Iterator[sqlite3.Connection]:
        with self._lock:
            age = self._age
            database = self._idle.pop() if self._idle else None
        if database is None:
            database = sqlite3.connect(
                f"{self._path.absolute().as_uri()}?mode=ro", uri=True, check_same_thread=False
            )
        with ExitStack() as undo:
            undo.callback(database.close)
            if identity(database, self._path) != file:
                raise Busy("history cannot be read: another file has taken its place")
            yield database
            undo.pop_all()
        with self._lock:
            if age == self._age:
                self._idle.append(database)
                return
        database.close()
