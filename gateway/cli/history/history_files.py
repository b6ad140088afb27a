"""Files of exported history: CSV for every program, Parquet for data tools."""

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from secrets import token_hex
from types import SimpleNamespace
from typing import Any, NamedTuple, TextIO

from gateway.config.sheets import neutral
from gateway.errors import ConfigError, words_of
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

_BATCH = 50_000  # rows of Parquet that are in memory
_EXACT = 2**53  # larger whole numbers have no exact float


class Column(NamedTuple):
    """`kind`: time (ns since 1970), text, word (one of few texts), value, number or count."""

    name: str
    kind: str


Rows = Iterable[Sequence[Any]]


def write_csv(stream: TextIO, columns: Sequence[Column], rows: Rows, *, comma: bool) -> int:
    """Writes rows; returns their number. `comma`: decimal commas, and `;` between cells."""
    # Its own ends of lines are \r\n, so that it quotes a cell with one of both.
    lines = SimpleNamespace(write=lambda line: stream.write(line[:-2] + "\n"))
    writer = csv.writer(lines, delimiter=";" if comma else ",")
    writer.writerow([column.name for column in columns])
    is_time = [column.kind == "time" for column in columns]
    count = 0
    for row in rows:
        writer.writerow([_cell(*cell, comma) for cell in zip(row, is_time, strict=True)])
        count += 1
    return count


def write_json(stream: TextIO, columns: Sequence[Column], rows: Rows) -> int:
    """Writes a document for each row; returns their number."""
    count = 0
    for row in rows:
        cells = {
            column.name: rfc3339(cell) if column.kind == "time" else cell
            for column, cell in zip(columns, row, strict=True)
        }
        stream.write(json.dumps(cells) + "\n")
        count += 1
    return count


def _cell(value: Value | None, is_time: bool, comma: bool) -> object:
    match value:
        case None:
            return ""
        case bool():
            return "true" if value else "false"
        case int() if is_time:
            return rfc3339(value)
        case float():
            return repr(value).replace(".", ",") if comma else repr(value)
        case tuple():
            return json.dumps(value)
        case str():
            return neutral(value)
    return value


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yields a path beside it, which gets its name at the end. Raises `ConfigError`."""
    if path.exists():
        raise ConfigError(f"{path} exists: name a new file")
    # Under a name that can be known, a link could wait that leads to another file.
    unfinished = path.with_name(f"{path.name}.{token_hex(8)}.unfinished")
    try:
        unfinished.open("xb").close()
        yield unfinished
        unfinished.rename(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {words_of(error)}") from None
    finally:
        unfinished.unlink(missing_ok=True)


def writer_of(path: Path, columns: Sequence[Column], *, comma: bool) -> Callable[[Path, Rows], int]:
    """Returns the writer that the name asks for. Raises `ConfigError`."""
    match path.suffix.lower():
        case ".parquet":
            return _parquet_writer(columns)
        case ".csv" | ".txt":

            def to_csv(unfinished: Path, rows: Rows) -> int:
                with unfinished.open("w", encoding="utf-8", newline="") as stream:
                    return write_csv(stream, columns, rows, comma=comma)

            return to_csv
    raise ConfigError(f"{path}: the name must end with .csv or .parquet")


def _parquet_writer(columns: Sequence[Column]) -> Callable[[Path, Rows], int]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ConfigError(
            "a .parquet file needs one more package: pip install pyarrow, or export CSV"
        ) from None
    types = {
        "time": pa.timestamp("us", tz="UTC"),
        "text": pa.string(),
        "word": pa.dictionary(pa.int32(), pa.string()),
        "value": pa.float64(),
        "number": pa.float64(),
        "count": pa.int64(),
    }
    fields = [(column.name, types[column.kind]) for column in columns]
    texts = [n for n, column in enumerate(columns) if column.name in ("value", "last")]
    schema = pa.schema([*fields, ("text", types["text"])])

    def write(unfinished: Path, rows: Rows) -> int:
        count, waiting = 0, iter(rows)
        with parquet.ParquetWriter(unfinished, schema) as file:
            while batch := [*islice(waiting, _BATCH)]:
                count += len(batch)
                cells: list[list[Any]] = [
                    [_SHOWN[column.kind](row[n]) for row in batch]
                    if column.kind in _SHOWN
                    else [row[n] for row in batch]
                    for n, column in enumerate(columns)
                ]
                cells.append([_text(row[texts[0]]) if texts else None for row in batch])
                arrays = [
                    pa.array(cell, type=field.type)
                    for cell, field in zip(cells, schema, strict=True)
                ]
                file.write_table(pa.Table.from_arrays(arrays, schema=schema))
        return count

    return write


def _number(value: Value | None) -> float | None:
    return None if value is None or isinstance(value, (str, tuple)) else float(value)


def _text(value: Value | None) -> str | None:
    """Returns what is no exact float: texts, long whole numbers, and arrays as JSON."""
    if isinstance(value, int) and abs(value) > _EXACT:
        return str(value)
    if isinstance(value, tuple):
        return json.dumps(value)
    return value if isinstance(value, str) else None


_SHOWN: Mapping[str, Callable[[Any], Any]] = {"value": _number, "time": lambda ns: ns // 1000}
