"""The history file: an SQLite database with one table of samples, in the order of recording.

A sample is written once, at the end of the table: a commit writes few pages however many tags there
are. When a run is closed, its index is written beside its time and size. Dropping the oldest run
frees whole pages at the beginning. Every method is one transaction.
"""

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import structlog

from gateway.contract.past.timerange import LATEST
from gateway.errors import Damaged
from gateway.parts.history.answers.outcomes import Outcome, Ring
from gateway.parts.history.answers.recent import Extent, Identity, SortedRun
from gateway.parts.history.files.aside import Salvaged, move
from gateway.parts.history.store.index import pack
from gateway.parts.history.store.lock import close_to_others, locked
from gateway.parts.history.store.rows import checksum, to_row, with_checksum
from gateway.parts.history.store.schema import prepare
from gateway.tags import Sample

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

BUSY_WITHIN = 1.0  # seconds another program may hold the file
LONGEST_INDEX = 2**16  # samples

# Many rows in one statement: SQLite releases the interpreter lock for each statement, and taking it
# again takes long when the event loop is busy.
_INSERTS = [
    (size, f"INSERT INTO sample VALUES {', '.join(['(?, ?, ?, ?, ?, ?, ?)'] * size)}")  # noqa: S608  (placeholders only)
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
            _check_numbers(self._database)
            self._tags, self._last_tag, _ = tags(self._database, 0)
            self.identity = identity(self._database, path)
            self._resources = undo.pop_all()

    def close(self) -> None:
        self._resources.close()

    # -- writing --

    def next_number(self) -> int:
        """Returns the number after that of the last sample."""
        return next_number(self._database)

    def store(self, number: int, samples: Sequence[Sample]) -> None:
        """Stores samples in the order of arrival; the first gets this number."""
        self.store_rows(number, [(sample.tag.recorded_key, *to_row(sample)) for sample in samples])

    def store_rows(self, number: int, columns: Sequence[Salvaged]) -> None:
        """Stores rows of keys and samples in their order; the first gets this number."""
        with self._transaction():
            rows = [
                with_checksum(n, self._tag(key), sample)
                for n, (key, *sample) in enumerate(columns, number)
            ]
            for size, insert in _INSERTS:
                while len(rows) >= size:
                    chunk, rows = rows[:size], rows[size:]
                    self._database.execute(insert, list(chain.from_iterable(chunk)))

    def _tag(self, key: str) -> int:
        number = self._tags.get(key)
        if number is None:
            number = self._last_tag = self._last_tag + 1
            row = number, key, checksum((number, key))
            self._database.execute("INSERT OR REPLACE INTO tag VALUES (?, ?, ?)", row)
            self._database.execute("UPDATE file SET tags = ?", (number,))
            self._tags[key] = number
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

    def close_run(self, number: int, end: int, now: int) -> SortedRun | None:
        """Writes the index of the samples from `number` to before `end`, if there are any."""
        with self._transaction():
            found = self._database.execute(
                "SELECT id, tag, time FROM sample WHERE id >= ? AND id < ? ORDER BY id",
                (number, end),
            ).fetchall()
            if not found:
                return None
            numbers, of_tags, times = zip(*found, strict=True)
            run = SortedRun(number, min(times), max(times), end - number, now)
            # Without an index the samples are read all: some of them are lost.
            is_whole = numbers == tuple(range(number, end))
            places = pack(of_tags, times) if is_whole else b""
            row = (*run, checksum(run[:]), places)
            self._database.execute("INSERT OR REPLACE INTO run VALUES (?, ?, ?, ?, ?, ?, ?)", row)
        return run

    def drop(self, run: SortedRun) -> None:
        with self._transaction():
            self._database.execute("UPDATE file SET oldest = ?", (run.end,))
            self._database.execute("DELETE FROM sample WHERE id < ?", (run.end,))
            self._database.execute("DELETE FROM run WHERE id < ?", (run.end,))

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

    def closed_runs(self, now: int, end: int) -> list[SortedRun]:
        """Returns the runs in their order. Closes what an earlier process left open, up to before
        the sample `end`, and what damage has taken the row of."""
        found = list[SortedRun]()
        for run in [*runs_of(self._database, end)]:
            if not run.closed:
                try:
                    run = self.close_run(run.number, run.end, now) or run
                except sqlite3.DatabaseError as error:
                    if not is_damage(error):
                        raise
            found.append(run)
        return found

    def extent(self, number: int, most: int) -> Extent:
        """Returns the extent of at most so many samples from a number on."""
        return extent(self._database, number, number + most)

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


def _check_numbers(database: sqlite3.Connection) -> None:
    """Raises `Damaged` for numbers that no gateway has given: what they count has no end."""
    match database.execute("SELECT mark, tags, oldest FROM file").fetchall():
        case [(bytes(), int(names), int(first))] if 0 <= names < 2**31 and 0 < first < 2**53:
            [(pages,)] = database.execute("PRAGMA page_count")
            if next_number(database) - first > pages * 4096:  # more samples than bytes
                raise Damaged("the numbers of its samples are damaged")
        case _:
            raise Damaged("its counters are damaged")


def identity(database: sqlite3.Connection, path: Path) -> Identity:
    """Returns the identity of the open file, if it is still at its path."""
    [(mark,)] = database.execute("SELECT mark FROM file")
    return Identity(path.stat().st_ino, mark)


def runs_of(database: sqlite3.Connection, end: int) -> Iterator[SortedRun]:
    """Yields the runs in their order. Samples before `end` without a run are runs that have never
    been closed. What cannot be read may be of any time: so every query finds the damage."""
    begin = oldest(database)
    rows = database.execute("SELECT id, first, last, samples, closed, sum FROM run ORDER BY id")
    known = [SortedRun(*head) for *head, total in rows if checksum(tuple(head)) == total]
    for run in [*known, None]:
        until = end if run is None else run.number
        for at in range(begin, until, LONGEST_INDEX):
            part_end = min(at + LONGEST_INDEX, until)
            try:
                first, last, count = extent(database, at, part_end)
            except sqlite3.DatabaseError as error:
                if not is_damage(error):
                    raise
                first, last, count = 0, LATEST, 1
            if count:
                yield SortedRun(at, first, last, part_end - at, 0)
        if run is not None:
            yield run
            begin = run.end


def extent(database: sqlite3.Connection, begin: int, end: int) -> Extent:
    """Returns the extent of the samples from a number to before another."""
    [found] = database.execute(
        "SELECT ifnull(min(time), 0), ifnull(max(time), 0), count(*) FROM sample"
        " WHERE id >= ? AND id < ?",
        (begin, end),
    )
    return Extent(*found)


def next_number(database: sqlite3.Connection) -> int:
    """Returns the number after that of the last sample."""
    [(last,)] = database.execute("SELECT ifnull(max(id), 0) FROM sample")
    [(end,)] = database.execute("SELECT ifnull(max(id + samples), 1) FROM run")
    return max(int(last) + 1, int(end), oldest(database))


def oldest(database: sqlite3.Connection) -> int:
    """Returns the number of the oldest sample that was not dropped."""
    [(number,)] = database.execute("SELECT oldest FROM file")
    return int(number)


def tags(database: sqlite3.Connection, after: int) -> tuple[dict[str, int], int, bool]:
    """Returns the tags with higher numbers than `after`, the highest number, and whether some names
    are damaged: they are left out. Raises `Damaged`."""
    [(last,)] = database.execute("SELECT tags FROM file")
    rows = database.execute("SELECT id, key, sum FROM tag WHERE id > ?", (after,)).fetchall()
    found = {key: number for number, key, total in rows if checksum((number, key)) == total}
    return found, max(last, after), len(found) != last - after


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
    move(path, aside)
    log.error("history file moved aside", why=why, moved_to=str(aside))
