"""The history file: an SQLite database that is written in order and sorted run by run.

Samples are stored in table `recent`, in the order of arrival. A closed run moves to `sample` in
one transaction, sorted by tag and time, at the end of that table: nothing is inserted in the
middle, so a commit writes few pages however many tags there are, and dropping the oldest run frees
whole pages at the beginning. Every method is one transaction.
"""

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import structlog

from gateway.parts.history import sections
from gateway.parts.history.lock import close_to_others, locked
from gateway.parts.history.outcomes import Outcome, Ring
from gateway.parts.history.recent import Extent, Identity, SortedRun
from gateway.parts.history.rows import to_row
from gateway.parts.history.schema import prepare
from gateway.tags import Sample

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

BUSY_WITHIN = 1.0  # seconds another program may hold the file

# Many rows in one statement: SQLite releases the interpreter lock for each statement, and taking it
# again takes long when the event loop is busy.
_INSERTS = [
    (size, f"INSERT INTO recent VALUES {', '.join(['(?, ?, ?, ?, ?, ?, ?)'] * size)}")  # noqa: S608  (placeholders only)
    for size in (128, 16, 1)
]


class HistoryFile:
    """The one connection that writes. Raises `sqlite3.Error` and `OSError` unchanged.

    `path` names the file itself, not a link to it. While it is open, another gateway that opens
    the file gets a `BlockingIOError`.
    """

    def __init__(self, path: Path, max_size: int) -> None:
        self.path = path
        self._log = Path(f"{path}-wal")
        # The size limit of the file includes its log.
        self.log_limit = max(256 * 1024, min(4 * 1024 * 1024, max_size // 16))
        with ExitStack() as undo:
            undo.callback(os.close, locked(path))
            close_to_others(path)  # SQLite gives its log the same mode
            self._database = _opened(path)
            undo.callback(self._database.close)
            pages = max(16, self.log_limit // (2 * 4096))
            self._database.execute(f"PRAGMA wal_autocheckpoint = {pages}")
            self._database.execute(f"PRAGMA journal_size_limit = {self.log_limit}")
            self._tags, self._last_tag, _ = sections.tags(self._database, 0)
            self.identity = identity(self._database, path)
            self._resources = undo.pop_all()

    def close(self) -> None:
        self._resources.close()

    # -- writing --

    def new_run(self) -> int:
        """Returns a number higher than any in use."""
        [(number,)] = self._database.execute(
            "SELECT 1 + max(ifnull((SELECT max(run) FROM run), 0),"
            " ifnull((SELECT max(run) FROM recent), 0))"
        )
        return int(number)

    def store(self, run: int, start: int, samples: Sequence[Sample]) -> None:
        """Stores samples of a run in the order of arrival; the first has number `start` in it."""
        with self._transaction():
            rows = [
                (run, n, self._tag(sample.tag.key), *to_row(sample))
                for n, sample in enumerate(samples, start)
            ]
            for size, insert in _INSERTS:
                while len(rows) >= size:
                    chunk, rows = rows[:size], rows[size:]
                    self._database.execute(insert, list(chain.from_iterable(chunk)))

    def _tag(self, key: str) -> int:
        number = self._tags.get(key)
        if number is None:
            number = self._tags[key] = self._last_tag = self._last_tag + 1
            self._database.execute("INSERT OR REPLACE INTO tag VALUES (?, ?)", (number, key))
            sections.write_tag(self._database, number, key)
        return number

    def store_writes(self, ring: Ring, outcomes: Sequence[Outcome], most: int) -> int:
        """Stores outcomes and keeps the newest `most` of the ring. Returns the number of the
        last."""
        with self._transaction():
            self._database.executemany(
                f"INSERT INTO {ring} (time, outcome) VALUES (?, ?)",  # noqa: S608  (our own name)
                outcomes,
            )
            self._database.execute(
                f"DELETE FROM {ring} WHERE id <= (SELECT max(id) FROM {ring}) - ?",  # noqa: S608
                (most,),
            )
            return self.last_write(ring)

    def sort(self, run: int, now: int) -> SortedRun | None:
        """Moves a run from `recent` to `sample`, which may hold its beginning already. Returns None
        if `recent` has nothing of it."""
        with self._transaction():
            [(first, last, count)] = self._database.execute(
                "SELECT min(time), max(time), count(*) FROM recent WHERE run = ?", (run,)
            )
            if not count:
                return None
            self._database.execute(
                "INSERT INTO sample SELECT run, tag, time, n, value, kind, bad FROM recent"
                " WHERE run = ? ORDER BY tag, time, n",
                (run,),
            )
            self._database.execute(
                "INSERT INTO run VALUES (?, ?, ?, ?, ?) ON CONFLICT (run) DO UPDATE SET"
                " first = min(first, excluded.first), last = max(last, excluded.last),"
                " samples = samples + excluded.samples, closed = excluded.closed",
                (run, first, last, count, now),
            )
            self._database.execute("DELETE FROM recent WHERE run = ?", (run,))
            sections.write(self._database, run)
            [row] = self._database.execute("SELECT * FROM run WHERE run = ?", (run,))
        return SortedRun(*row)

    def drop(self, run: int) -> None:
        with self._transaction():
            self._database.execute("DELETE FROM sample WHERE run = ?", (run,))
            sections.drop(self._database, run)
            self._database.execute("DELETE FROM run WHERE run = ?", (run,))

    def drop_writes(self, before: int) -> None:
        """Drops some outcomes from before this time, if there are any."""
        with self._transaction():
            for ring in Ring:
                self._database.execute(
                    f"DELETE FROM {ring} WHERE id IN"  # noqa: S608  (our own name)
                    f" (SELECT id FROM {ring} WHERE time < ? ORDER BY time LIMIT 256)",
                    (before,),
                )

    def set_sync(self, full: bool) -> None:
        """`full`: the next transactions wait until they are safe from a power cut."""
        self._database.execute(f"PRAGMA synchronous = {'FULL' if full else 'NORMAL'}")

    def shrink(self) -> None:
        """Returns some unused pages to the disk, if an eighth of the file is unused."""
        if self._pragma("freelist_count") * 8 > self._pragma("page_count"):
            # `execute` would return one page only: this pragma takes a step for each.
            self._database.executescript("PRAGMA incremental_vacuum(256)")

    def empty_log(self) -> None:
        """Moves the log into the database file, as far as no reader uses an old state."""
        self._database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    # -- content --

    def sorted_runs(self) -> list[SortedRun]:
        return sections.runs(self._database)

    def unsorted_runs(self) -> dict[int, Extent]:
        """Returns the extent of each run in `recent`."""
        rows = self._database.execute(
            "SELECT run, min(time), max(time), count(*) FROM recent GROUP BY run ORDER BY run"
        )
        return {run: Extent(*extent) for run, *extent in rows}

    def last_write(self, ring: Ring) -> int:
        """Returns the number of the last outcome of the ring, 0 if there is none."""
        [(number,)] = self._database.execute(f"SELECT ifnull(max(id), 0) FROM {ring}")  # noqa: S608
        return int(number)

    def size(self) -> int:
        """Returns the bytes on disk, the log included."""
        return self.path.stat().st_size + self.log_size()

    def log_size(self) -> int:
        try:
            return self._log.stat().st_size
        except FileNotFoundError:
            return 0

    def used(self) -> int:
        """Returns the bytes of the pages in use, without the log."""
        return (self._pragma("page_count") - self._pragma("freelist_count")) * 4096

    def is_in_place(self) -> bool:
        """True if the path still names the open file."""
        try:
            return self.path.stat().st_ino == self.identity.inode
        except FileNotFoundError:
            return False

    def _pragma(self, name: str) -> int:
        [(number,)] = self._database.execute(f"PRAGMA {name}")
        return int(number)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._database.execute("BEGIN IMMEDIATE")
        try:
            yield
            self._database.execute("COMMIT")
        finally:
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")


def identity(database: sqlite3.Connection, path: Path) -> Identity:
    """Returns the identity of the open file, if it is still at its path."""
    [(mark,)] = database.execute("SELECT mark FROM file")
    return Identity(path.stat().st_ino, mark)


def is_damage(error: sqlite3.Error) -> bool:
    """True if the file is damaged, or no SQLite database."""
    name = getattr(error, "sqlite_errorname", "")
    return name.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB"))


def _opened(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(
        path, timeout=BUSY_WITHIN, isolation_level=None, check_same_thread=False
    )
    with ExitStack() as undo:
        undo.callback(database.close)
        prepare(database, path)
        undo.pop_all()
    return database


def move_aside(path: Path, why: str) -> None:
    """Renames an unusable file, together with the files that SQLite keeps beside it."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    aside = path.with_name(f"{path.name}.aside-{stamp}")
    path.rename(aside)
    for tail in ("-wal", "-shm", "-journal"):
        companion = Path(f"{path}{tail}")
        if companion.exists():
            companion.rename(f"{aside}{tail}")
    log.error("history file moved aside", why=why, moved_to=str(aside))
