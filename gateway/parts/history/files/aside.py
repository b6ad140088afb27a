"""History files that were moved aside: named until a person knows, and read in spite of damage.

Each page of such a file is read by itself. Each sample has a checksum, so that a sample that is
found on any page is sound, whatever became of the trees that led to it.
"""

import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path

import orjson

from gateway.parts.history.answers.outcomes import Outcome, Ring
from gateway.parts.history.store.rows import Stored, checksum

_TAILS = ("-wal", "-shm", "-journal")
_PAGE = 4096
_LEAF = 13  # type of a page with rows of a table
_INTEGERS = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}  # bytes by serial type
_SAMPLE, _TAG = 7, 3  # columns
_ELSEWHERE = (None, 0)  # a row that is on more than one page
_BATCH = 5000

# The columns `key, time, value, kind, bad`.
Salvaged = tuple[str, int, Stored, int | None, str | None]


def asides(path: Path, word: str = "aside") -> list[Path]:
    """Returns the files that were moved aside, the oldest first."""
    with suppress(OSError):
        start = f"{path.name}.{word}-"
        found = (one for one in path.parent.iterdir() if one.name.startswith(start))
        return sorted(one for one in found if one.name.endswith("Z"))
    return []


def rename(aside: Path, word: str) -> Path:
    """Gives a file another word than `aside`: it is no fault any more. Raises `OSError`."""
    head, _, stamp = aside.name.rpartition(".aside-")
    renamed = aside.with_name(f"{head}.{word}-{stamp}")
    move(aside, renamed)
    return renamed


def move(path: Path, to: Path) -> None:
    """Renames a file, together with the files that SQLite keeps beside it. Raises `OSError`."""
    path.rename(to)
    for tail in _TAILS:
        companion = Path(f"{path}{tail}")
        if companion.exists():
            companion.rename(f"{to}{tail}")


def rows(path: Path) -> Iterator[list[Salvaged]]:
    """Yields the sound samples of a file in the order of recording. Raises `OSError`."""
    tags, pages = dict[int, str](), list[tuple[int, Path, int]]()
    for source, at, page in _pages(path):
        sound, long = list[int](), list[int]()
        for number, row in _cells(page):
            match row:
                case (None, str() as key, int()) if checksum((number, key)) == row[2]:
                    tags[number] = key
                case _ if row is _ELSEWHERE:
                    long.append(number)
                case _ if _is_sound(number, row):
                    sound.append(number)
        if numbers := sound or long:
            pages.append((min(numbers), source, at))
    last = 0
    with closing(sqlite3.connect(path)) as database:
        for _, source, at in sorted(pages):
            with source.open("rb") as file:
                file.seek(at)
                found = [*_cells(file.read(_PAGE))]
            columns = {
                number: (tags[tag], *sample)
                for number, row in found
                if number > last and (whole := _checked(number, row, database)) is not None
                for tag, *sample in [whole]
                if tag in tags
            }
            last = max(columns, default=last)
            yield [columns[number] for number in sorted(columns)]  # type: ignore[misc]  # `_checked`
    if not pages:
        yield from _of_first_format(path)


def _is_sound(number: int, row: tuple[Stored, ...]) -> bool:
    return len(row) == _SAMPLE and checksum((number, *row[1:6])) == row[6]


def _checked(
    number: int, row: tuple[Stored, ...], database: sqlite3.Connection
) -> tuple[int, int, Stored, int | None, str | None] | None:
    """Returns the columns `tag, time, value, kind, bad` of a sample; None for a damaged one."""
    if row is _ELSEWHERE:
        with suppress(sqlite3.Error, ValueError, OverflowError):
            for found in database.execute("SELECT * FROM sample WHERE id = ?", (number,)):
                row = found
    match row:
        case (_, int(tag), int(time), value, None | int() as kind, None | str() as bad, total):
            if checksum((number, tag, time, value, kind, bad)) == total:
                return tag, time, value, kind, bad
    return None


def _of_first_format(path: Path) -> Iterator[list[Salvaged]]:
    """Yields the samples of a gateway before format 2, as far as SQLite can read them."""
    with suppress(sqlite3.Error, ValueError), closing(sqlite3.connect(path)) as database:
        for table in ("sample", "recent"):
            found = database.execute(
                f"SELECT key, time, value, kind, bad FROM {table} JOIN tag ON tag.id = tag"  # noqa: S608
                " ORDER BY run, n"
            )
            while batch := found.fetchmany(_BATCH):
                yield batch


def outcomes(path: Path, ring: Ring) -> Sequence[Outcome]:
    """Returns the outcomes of a file, as far as SQLite can read them."""
    found: list[Outcome] = []
    with suppress(sqlite3.Error, ValueError), closing(sqlite3.connect(path)) as database:
        for time, text in database.execute(f"SELECT time, outcome FROM {ring} ORDER BY id"):  # noqa: S608
            if isinstance(time, int) and orjson.loads(text):
                found.append(Outcome(time, text))
    return found


def _pages(path: Path) -> Iterator[tuple[Path, int, bytes]]:
    """Yields the pages of the file and of its log, each with its place."""
    for source, begin, head in ((path, 0, 0), (Path(f"{path}-wal"), 32, 24)):
        with suppress(FileNotFoundError), source.open("rb") as file:
            at = begin + head
            file.seek(at)
            while page := file.read(_PAGE):
                yield source, at, page
                file.seek(at := at + _PAGE + head)


def _cells(page: bytes) -> Iterator[tuple[int, tuple[Stored, ...]]]:
    """Yields the rows of a page with their numbers; what cannot be parsed is left out."""
    if len(page) < _PAGE or page[0] != _LEAF:
        return
    count = struct.unpack_from(">H", page, 3)[0]
    for at in struct.unpack_from(f">{min(count, _PAGE // 4)}H", page, 8):
        with suppress(IndexError, struct.error, UnicodeDecodeError):
            size, at = _varint(page, at)
            number, at = _varint(page, at)
            if size > _PAGE - 35:
                yield number, _ELSEWHERE
            elif (row := _record(page[at : at + size])) is not None:
                yield number, row


def _record(data: bytes) -> tuple[Stored, ...] | None:
    """Parses the columns of a sample or a tag."""
    head, at = _varint(data, 0)
    kinds = []
    while at < head:
        kind, at = _varint(data, at)
        kinds.append(kind)
    if len(kinds) not in (_SAMPLE, _TAG):
        return None
    row: list[Stored] = []
    for kind in kinds:
        size = _INTEGERS.get(kind, 8 if kind == 7 else max(0, (kind - 12) // 2))
        part, at = data[at : at + size], at + size
        match kind:
            case 0:
                row.append(None)
            case 7:
                row.append(struct.unpack(">d", part)[0])
            case 8 | 9:
                row.append(kind - 8)
            case _ if kind < 7:
                row.append(int.from_bytes(part, "big", signed=True))
            case _:
                row.append(part.decode() if kind % 2 else part)
    return tuple(row)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Returns a number of SQLite's variable length, and the place after it."""
    found = 0
    for n in range(8):
        found = found << 7 | data[at + n] & 0x7F
        if data[at + n] < 0x80:
            return found, at + n + 1
    return found << 8 | data[at + 8], at + 9
