"""Parquet files in a folder or on S3: `date=2026-11-20/gateway=plant,demo/part-0000.parquet`.

A file is replaced whole, so a reader never sees half of one. A part grows until it has `PART` rows;
then the next one begins. `_archive/<gateway>.json` has the cursor and, before a page is written,
the number of rows that each of its parts had. After a crash the next page finds these numbers: the
parts are cut to them first.
"""

import fcntl
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import orjson
import pyarrow as pa
from pyarrow import fs
from pyarrow import parquet as pq

from gateway.archive.rows import Row
from gateway.archive.store import Cursor, Overtaken, StoreDown, cursor_of
from gateway.errors import ConfigError, words_of
from gateway.files import put

_DAY = 86400 * 10**6  # microseconds
PART = 250_000  # rows of a file
_MOST_KNOWN = 10_000  # partitions whose last part is remembered
_GROUP = 50_000  # rows of which a reader skips those of another time
SCHEMA = pa.schema(
    [
        pa.field("time", pa.timestamp("us", tz="UTC"), nullable=False),
        pa.field("key", pa.string(), nullable=False),
        pa.field("value", pa.float64()),
        pa.field("text", pa.string()),
        pa.field("elements", pa.list_(pa.float64())),
        pa.field("quality", pa.string(), nullable=False),
        pa.field("reason", pa.string()),
        pa.field("origin", pa.string()),
        pa.field("limited", pa.string()),
    ]
)
Pending = dict[str, int]  # rows of each part before a page, by its path


class ParquetStore:
    """See `Store`. An S3 address has the options of pyarrow, such as `?region=eu-central-1`."""

    every = 300.0  # each look that finds samples writes a part again

    def __init__(self, place: str) -> None:
        try:
            if "://" in place:
                self.files, root = fs.FileSystem.from_uri(place)
            else:
                self.files, root = fs.LocalFileSystem(), str(Path(place).absolute())
        except (pa.ArrowInvalid, ValueError) as error:
            raise ConfigError(f"{place}: {error}") from None
        if not (root := root.rstrip("/")):
            raise ConfigError(f"{place} names no folder: s3://bucket/folder, or a folder")
        self.root = root
        self._is_local = isinstance(self.files, fs.LocalFileSystem)
        self._last: dict[str, tuple[str, int]] = {}  # of each partition: last part, its rows

    def cursors(self) -> Mapping[str, Cursor]:
        found = {}
        with _failures():
            self._last.clear()
            chosen = fs.FileSelector(f"{self.root}/_archive", allow_not_found=True)
            for one in self.files.get_file_info(chosen):
                if one.base_name.endswith(".json"):
                    cursor, _ = self._read(one.path)
                    found[cursor.gateway] = cursor
        return found

    def add(self, rows: Sequence[Row], before: Cursor, after: Cursor) -> Cursor:
        path = self._cursor_path(before.gateway)
        with _failures(), self._locked(path):
            with suppress(FileNotFoundError):
                cursor, pending = self._read(path)
                if cursor.after != before.after:
                    raise Overtaken(before.gateway)
                self._take_back(pending)
            days = dict(self._new(rows, before.gateway, known=after.overlaps))
            after = after.with_rows(rows, sum(map(len, days.values())))
            if days:
                places = {folder: self._place(folder) for folder in days}
                self._save(path, before, dict(places.values()))
                for folder, new in days.items():
                    self._append(folder, *places[folder], new)
            self._save(path, after, {})
        return after

    def close(self) -> None:
        pass

    @contextmanager
    def _locked(self, cursor: str) -> Iterator[None]:
        """Keeps other archivers of the gateway away, also one that this one does not see. S3 and
        some network file systems have no lock."""
        if not self._is_local:
            yield
            return
        Path(cursor).parent.mkdir(parents=True, exist_ok=True)
        with Path(f"{cursor}.lock").open("wb") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreDown("another archiver writes into this folder") from None
            except OSError:
                pass
            yield

    # -- parts --

    def _new(
        self, rows: Sequence[Row], gateway: str, *, known: bool
    ) -> Iterator[tuple[str, list[Row]]]:
        """Yields the rows by partition; `known`: without those that are there already."""
        days: dict[int, list[Row]] = {}
        for row in rows:
            days.setdefault(row.time // _DAY, []).append(row)
        for day, of_day in days.items():
            date = datetime.fromtimestamp(day * _DAY // 10**6, UTC).date()
            folder = f"date={date}/gateway={_name(gateway)}"
            if known:
                there = self._known(folder, of_day)
                of_day = [row for row in dict.fromkeys(of_day) if row not in there]
            if of_day:
                yield folder, of_day

    def _known(self, folder: str, rows: Sequence[Row]) -> set[Row]:
        """Returns the stored rows of the same time."""
        first, last = (
            pa.scalar(limit(row.time for row in rows), SCHEMA.field("time").type)
            for limit in (min, max)
        )
        found: set[Row] = set()
        for path in self._parts(folder):
            of_time = [("time", ">=", first), ("time", "<=", last)]
            table = self._table(path, of_time)
            found.update(_rows(table))
        return found

    def _place(self, folder: str) -> tuple[str, int]:
        """Returns the part that the next rows go to, and how many it has."""
        path, count = self._last.get(folder) or self._found(folder)
        if count < PART:
            return path, count
        head, _, number = path.removesuffix(".parquet").rpartition("-")
        return f"{head}-{int(number) + 1:04}.parquet", 0

    def _found(self, folder: str) -> tuple[str, int]:
        if not (paths := self._parts(folder)):
            return f"{folder}/part-0000.parquet", 0
        with self.files.open_input_file(paths[-1]) as file:
            count = pq.ParquetFile(file).metadata.num_rows
        return paths[-1].removeprefix(f"{self.root}/"), count

    def _parts(self, folder: str) -> list[str]:
        chosen = fs.FileSelector(f"{self.root}/{folder}", allow_not_found=True)
        return sorted(
            one.path for one in self.files.get_file_info(chosen) if one.path.endswith(".parquet")
        )

    def _append(self, folder: str, path: str, count: int, rows: Sequence[Row]) -> None:
        """Replaces a part by one with these rows after the first `count`."""
        whole = f"{self.root}/{path}"
        table = _table(rows)
        if count:
            table = pa.concat_tables([self._table(whole), table], promote_options="default")
        self._write(whole, table)
        if len(self._last) >= _MOST_KNOWN:
            self._last.clear()
        self._last[folder] = path, count + len(rows)

    def _take_back(self, pending: Pending) -> None:
        """Cuts parts to the rows before a page that a crash has interrupted."""
        for place, count in pending.items():
            self._last.clear()
            path = f"{self.root}/{place}"
            with suppress(FileNotFoundError):
                if not count:
                    self.files.delete_file(path)
                elif (table := self._table(path)).num_rows > count:
                    self._write(path, table.slice(0, count))

    def _table(self, path: str, filters: Any = None) -> Any:
        with self.files.open_input_file(path) as file:
            table = pq.read_table(file, filters=filters)
        # Of an earlier version: its columns, and empty ones in place of later ones.
        return pa.concat_tables([table, SCHEMA.empty_table()], promote_options="default")

    def _write(self, path: str, table: Any) -> None:
        data = pa.BufferOutputStream()
        pq.write_table(table, data, compression="zstd", row_group_size=_GROUP)
        self._put(path, data.getvalue())

    # -- cursors --

    def _cursor_path(self, gateway: str) -> str:
        return f"{self.root}/_archive/{_name(gateway)}.json"

    def _read(self, path: str) -> tuple[Cursor, Pending]:
        with self.files.open_input_file(path) as file:
            text = file.read()
        try:
            found = orjson.loads(text)
            return cursor_of(orjson.dumps(found["cursor"])), dict(found["pending"])
        except (ValueError, TypeError, KeyError):
            raise StoreDown(f"{path} is damaged: {text[:100]!r}") from None

    def _save(self, path: str, cursor: Cursor, pending: Pending) -> None:
        document = {"cursor": orjson.loads(cursor.to_json()), "pending": pending}
        self._put(path, orjson.dumps(document))

    # -- files --

    def _put(self, path: str, data: Any) -> None:
        """Replaces a file whole. It is on the disk then."""
        if not self._is_local:  # an object of S3 appears when it is complete
            with self.files.open_output_stream(path) as stream:
                stream.write(data)
            return
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        put(Path(path), bytes(data), 0o644)


def _name(gateway: str) -> str:
    """Returns the name of a gateway's files: `plant,demo` for `plant/@gateway/demo`."""
    chunks = gateway.replace("/@gateway/", "/").split("/")
    return ",".join(quote(chunk, safe="") for chunk in chunks)


@contextmanager
def _failures() -> Iterator[None]:
    """Raises `StoreDown` for an `OSError`: those of a disk and of S3."""
    try:
        yield
    except (OSError, pa.ArrowException) as error:
        raise StoreDown(words_of(error).partition("\n")[0]) from None


def _table(rows: Sequence[Row]) -> Any:
    if not rows:
        return SCHEMA.empty_table()
    times, keys, values, texts, arrays, reasons, origins, limited = zip(*rows, strict=True)
    qualities = [row.quality for row in rows]
    columns = (times, keys, values, texts, arrays, qualities, reasons, origins, limited)
    return pa.table(
        [pa.array(column, one.type) for column, one in zip(columns, SCHEMA, strict=True)],
        schema=SCHEMA,
    )


def _rows(table: Any) -> Iterator[Row]:
    times = table["time"].cast(pa.int64()).to_pylist()
    arrays = [None if one is None else tuple(one) for one in table["elements"].to_pylist()]
    names = ("key", "value", "text", "reason", "origin", "limited")
    keys, values, texts, *words = (table[name].to_pylist() for name in names)
    yield from map(Row, times, keys, values, texts, arrays, *words)
