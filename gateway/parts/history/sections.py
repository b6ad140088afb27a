"""Checksums of sorted runs, so that damage is found and the rest is still answered.

A sorted run is divided into sections of consecutive samples. Table `section` has the first sample
of each, the number of samples and their checksum. Section -1 has the checksum of the run's own row
and of this list. A run that an older gateway has sorted has no sections and cannot be checked. Run
0 has the checksums of the names of the tags.
"""

import marshal
import sqlite3
from bisect import bisect_right
from collections.abc import Collection, Sequence
from itertools import chain
from typing import Any, NamedTuple
from zlib import crc32

from gateway.contract.timerange import LATEST, TimeRange
from gateway.errors import Damaged
from gateway.parts.history.recent import SortedRun
from gateway.parts.history.rows import Stored

SECTION = 128  # samples
_GROUP = 2048  # samples that are read at once
TABLE = """
CREATE TABLE IF NOT EXISTS section (
    run INTEGER, number INTEGER, tag INTEGER, time INTEGER, n INTEGER,
    samples INTEGER, sum INTEGER, PRIMARY KEY (run, number)
) WITHOUT ROWID
"""
_ERRORS = (sqlite3.Error, UnicodeDecodeError)  # the latter: SQLite quotes damaged text
_END = (2**62, 0, 0)  # after the place of every sample

# The columns `tag, time, n, value, kind, bad`; the first three are the place in the run.
FullRow = tuple[int, int, int, Stored, int | None, str | None]
Place = tuple[int, int, int]


class Section(NamedTuple):
    """The samples from place `first` to before `end`. `sum` is None for a run without checksums."""

    first: Place
    end: Place
    samples: int
    sum: int | None


def checksum(content: list[Any] | tuple[Any, ...]) -> int:
    """Of rows. marshal's second format never changes, and takes a sixth of the time of `repr`."""
    return crc32(marshal.dumps(content, 2))


def write(database: sqlite3.Connection, run: int) -> None:
    """Makes the sections of a run that was just sorted. Call it in the same transaction."""
    found = _rows(database, run, (-1, 0, 0), _END)
    listed = [
        (number, *part[0][:3], len(part), checksum(part))
        for number, begin in enumerate(range(0, len(found), SECTION))
        if (part := found[begin : begin + SECTION])
    ]
    drop(database, run)
    insert = f"INSERT INTO section VALUES ({run:d}, ?, ?, ?, ?, ?, ?)"  # noqa: S608
    database.executemany(insert, listed)
    head = checksum((_row_of(database, run), listed))
    database.execute(insert, (-1, 0, 0, 0, len(found), head))


def drop(database: sqlite3.Connection, run: int) -> None:
    database.execute("DELETE FROM section WHERE run = ?", (run,))


def read(database: sqlite3.Connection, run: int) -> list[Section]:
    """Returns the sections of a run. Raises `Damaged` if the list itself is damaged."""
    try:
        listed = database.execute(
            "SELECT number, tag, time, n, samples, sum FROM section WHERE run = ? ORDER BY number",
            (run,),
        ).fetchall()
        row = _row_of(database, run)
    except _ERRORS as error:
        raise _damaged(error) from error
    if not listed and all(isinstance(value, int) for value in chain(*row)):
        return [Section((-1, 0, 0), _END, 0, None)]
    (*_, head), *found = listed or [(None,)]
    if head != checksum((row, found)):
        raise Damaged(f"the list of run {run} is damaged")
    ends = [*(first for _, *first, _, _ in found[1:]), _END]
    return [
        Section((tag, time, n), (end[0], end[1], end[2]), samples, expected)
        for (_, tag, time, n, samples, expected), end in zip(found, ends, strict=True)
    ]


def runs(database: sqlite3.Connection) -> list[SortedRun]:
    """Returns all sorted runs in their order. One whose row is damaged or lost may have samples of
    any time: so every query finds the damage. Raises `Damaged` if the table has no numbers."""
    known = {row[0]: row for row in database.execute("SELECT * FROM run")}
    if not all(isinstance(run, int) for run in known):
        raise Damaged("the table of runs is damaged")
    heads = database.execute("SELECT run FROM section WHERE number = -1")
    found = []
    for run in sorted({*known, *(run for (run,) in heads if isinstance(run, int) and run > 0)}):
        try:
            read(database, run)
            found.append(SortedRun(*known[run]))
        except (Damaged, KeyError):
            found.append(SortedRun(run, 0, LATEST, 1, 0))
    return found


def groups(
    sections: Sequence[Section], tags: Collection[int], period: TimeRange
) -> list[list[Section]]:
    """Returns the sections that may hold samples of the tags in the period, in groups of
    neighbours."""
    firsts = [section.first for section in sections]
    wanted: Collection[int] = range(len(sections))
    if len(tags) < len(sections):
        wanted = {
            number
            for tag in tags
            for number in range(
                max(0, bisect_right(firsts, (tag, period.first, -1)) - 1),
                bisect_right(firsts, (tag, period.last, _END[0])),
            )
        }
    found: list[list[Section]] = []
    last = -2
    for number in sorted(wanted):
        if number != last + 1 or len(found[-1]) >= _GROUP // SECTION:
            found.append([])
        found[-1].append(sections[number])
        last = number
    return found


def rows(database: sqlite3.Connection, run: int, sections: Sequence[Section]) -> list[FullRow]:
    """Returns the checked rows of neighbouring sections. Raises `Damaged`."""
    try:
        found = _rows(database, run, sections[0].first, sections[-1].end)
    except _ERRORS as error:
        raise _damaged(error) from error
    if sections[0].sum is None:
        return found
    begin = 0
    for section in sections:
        end = begin + section.samples
        if checksum(found[begin:end]) != section.sum:
            raise Damaged(f"a part of run {run} is damaged")
        begin = end
    if begin != len(found):
        raise Damaged(f"a part of run {run} is damaged")
    return found


def neighbour(
    database: sqlite3.Connection, last_run: int, tag: int, time: int, *, later: bool
) -> tuple[int, int] | None:
    """Returns the run and the time of the last sample of a tag before `time`, or of the first one
    after it; one search in the index for each run. Raises `Damaged`."""
    nearest, beyond = ("min", ">") if later else ("max", "<")
    run, order = ("last", "ASC") if later else ("first", "DESC")
    try:
        found = database.execute(
            f"SELECT run, (SELECT {nearest}(time) FROM sample WHERE sample.run = run.run"  # noqa: S608
            f" AND tag = ?1 AND time {beyond} ?2) AS nearest FROM run WHERE {run} {beyond} ?2"
            f" AND run <= ?3 AND nearest IS NOT NULL ORDER BY nearest {order}, run {order} LIMIT 1",
            (tag, time, last_run),
        ).fetchall()
    except _ERRORS as error:
        raise _damaged(error) from error
    return (int(found[0][0]), int(found[0][1])) if found else None


def latest_before(database: sqlite3.Connection, run: int, time: int) -> int | None:
    """Returns the time of the last sample of any tag in a run before `time`. Raises `Damaged`."""
    try:
        [(found,)] = database.execute(
            "SELECT max(time) FROM sample WHERE run = ? AND time < ?", (run, time)
        )
    except _ERRORS as error:
        raise _damaged(error) from error
    return found if isinstance(found, int) else None


def write_tag(database: sqlite3.Connection, number: int, key: str) -> None:
    """Writes the checksum of a tag's name."""
    database.execute(
        "INSERT OR REPLACE INTO section VALUES (0, ?, 0, 0, 0, 0, ?)", (number, checksum([key]))
    )


def tags(database: sqlite3.Connection, after: int) -> tuple[dict[str, int], int, bool]:
    """Returns the tags with higher numbers than `after`, in their order, the highest number, and
    whether some names are damaged: they are left out."""
    try:
        sums = dict(
            database.execute(
                "SELECT number, sum FROM section WHERE run = 0 AND number > ?", (after,)
            ).fetchall()
        )
        stored = database.execute(
            "SELECT id, key FROM tag WHERE id > ? ORDER BY id", (after,)
        ).fetchall()
    except _ERRORS as error:
        raise _damaged(error) from error
    found = {key: number for number, key in stored if sums.get(number) == checksum([key])}
    last = max([after, *sums, *(number for number, _ in stored)])
    return found, last, len(found) != len(sums) or len(found) != len(stored)


def adopt_tags(database: sqlite3.Connection) -> None:
    """Writes the checksums of all names, for a file of an older gateway."""
    if database.execute("SELECT 1 FROM section WHERE run = 0 LIMIT 1").fetchall():
        return
    stored = database.execute("SELECT id, key FROM tag").fetchall()
    database.execute("BEGIN IMMEDIATE")
    for number, key in stored:
        write_tag(database, number, key)
    database.execute("COMMIT")


def _rows(database: sqlite3.Connection, run: int, first: Place, end: Place) -> list[FullRow]:
    return database.execute(
        "SELECT tag, time, n, value, kind, bad FROM sample WHERE run = ?"
        " AND (tag, time, n) >= (?, ?, ?) AND (tag, time, n) < (?, ?, ?) ORDER BY tag, time, n",
        (run, *first, *end),
    ).fetchall()


def _row_of(database: sqlite3.Connection, run: int) -> list[tuple[int, ...]]:
    return database.execute("SELECT * FROM run WHERE run = ?", (run,)).fetchall()


def _damaged(error: Exception) -> Exception:
    """Translates an error of a damaged file. Text that is no UTF-8 has no code of its own."""
    name = getattr(error, "sqlite_errorname", "")
    if name.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")) or not name:
        return Damaged(str(error))
    return error
