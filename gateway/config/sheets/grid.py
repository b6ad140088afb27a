"""Files as rows of texts: encoding, delimiter, quotes, numbered as a spreadsheet numbers them."""

import csv
import io
import itertools
import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from gateway.config.sheets.columns import titles_in
from gateway.config.sheets.projects import Project, read_project
from gateway.config.sheets.workbooks import tables_of
from gateway.errors import ConfigError

DELIMITERS = ";,\t"
MOST_BYTES = 20_000_000  # a sheet of 10,000 tags has one
HEADER_ROWS = 20  # the titles are in one of the first rows
_MOST_CELL = 10_000  # characters
_SEP = re.compile(r"sep=(.)\r?\n?\Z", re.IGNORECASE)
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
_BOMS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_HIGH = re.compile(rb"[\x80-\xff]+")
# Encodings of Chinese Excel; the narrowest first, so that a wrong one rarely fits.
_CHINESE = ("gb2312", "big5", "gb18030")
# A spreadsheet takes a text that begins with one of these for a formula, and performs it.
_FORMULA = tuple("=+-@\t\r\n＝＋－＠")
_QUOTE = "'"  # before it: a text


class Row(NamedTuple):
    """`number` counts from 1, as the spreadsheet shows it."""

    number: int
    cells: list[str]


class Grid(NamedTuple):
    """All rows. `decimal`: the decimal mark that the file must have, if its form tells.

    `project`: where the rows are the tags of one, numbered from 1.
    """

    rows: list[Row]
    decimal: str | None
    project: Project | None = None


def read_grid(data: bytes) -> Grid:
    """Returns the rows of a file; of a workbook those of the sheet with the most titles.

    Raises `ConfigError` where the file is no sheet.
    """
    if len(data) > MOST_BYTES:
        raise ConfigError(
            f"the file has more than {MOST_BYTES // 10**6} MB: it is no sheet of tags"
        )
    if data.startswith(_WORKBOOKS):
        return Grid(_workbook(data), ".")
    text = _decoded(data)
    project = read_project(text)
    if project is None:
        return _delimited(text)
    return Grid([Row(*row) for row in enumerate(project.rows)], ".", project)


def neutral(text: str) -> str:
    """Returns a text as a cell of CSV that no spreadsheet performs. `read_grid` takes it back."""
    return _QUOTE + text if text.startswith((*_FORMULA, _QUOTE)) else text


def _plain(cell: str) -> str:
    return cell[1:] if cell[:1] == _QUOTE and cell[1:].startswith((*_FORMULA, _QUOTE)) else cell


def _decoded(data: bytes) -> str:
    for bom, encoding in _BOMS.items():
        if data.startswith(bom):
            return _decode(data, encoding)
    half = len(data) // 2
    if half and data[1::2].count(0) > 0.3 * half:
        return _decode(data, "utf-16-le")
    if half and data[::2].count(0) > 0.3 * half:
        return _decode(data, "utf-16-be")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode(_legacy(data), "replace")


def _decode(data: bytes, encoding: str) -> str:
    try:
        return data.decode(encoding)
    except UnicodeDecodeError:
        raise ConfigError(f"the file is damaged: it begins as {encoding}, but is not") from None


def _legacy(data: bytes) -> str:
    """Returns the encoding of a file without Unicode: Western, or Chinese by its pairs of bytes."""
    runs = [len(run) for run in _HIGH.findall(data)]
    pairs = sum(length for length in runs if length > 1)
    if 2 * pairs > sum(runs):
        for encoding in _CHINESE:
            try:
                data.decode(encoding)
            except UnicodeDecodeError:
                continue
            return encoding
    return "cp1252" if not re.search(rb"[\x81\x8d\x8f\x90\x9d]", data) else "latin-1"


def _delimited(text: str) -> Grid:
    if "\0" in text:
        raise ConfigError("the file has NUL characters: it is no text")
    first, _, rest = text.partition("\n")
    if match := _SEP.match(first):  # Excel does not show this line
        delimiter, text = match[1], rest
    else:
        delimiter = max(DELIMITERS, key=lambda one: (_score(text, one), first.count(one)))
    rows = list(_records(text, delimiter))
    return Grid(rows, "." if delimiter == "," else None)


def _score(text: str, delimiter: str) -> int:
    """Returns the number of known titles that the first rows have with this delimiter."""
    try:
        return _titles(_records(text, delimiter))
    except ConfigError:
        return 0


def _records(text: str, delimiter: str) -> Iterator[Row]:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
    number = 0
    while True:
        number += 1
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error:
            raise ConfigError(
                f'row {number}: a quote (") that is not closed, or text after a closed one: '
                "inside a quoted cell write it twice"
            ) from None
        yield Row(number, _trimmed(map(_plain, cells)))


def _trimmed(cells: Iterable[str]) -> list[str]:
    """Returns the cells without spaces around them and without empty ones at the end."""
    found = [" ".join(cell[:_MOST_CELL].split()) for cell in cells]
    while found and not found[-1]:
        found.pop()
    return found


def _workbook(data: bytes) -> list[Row]:
    tables = [
        [Row(number, _trimmed(map(cell_text, cells))) for number, cells in enumerate(table, 1)]
        for table in tables_of(data)
    ]
    return max(tables, key=_titles, default=[])


def _titles(rows: Iterable[Row]) -> int:
    """Returns the number of known titles in the best of the first rows."""
    return max((titles_in(row.cells) for row in itertools.islice(rows, HEADER_ROWS)), default=0)


def cell_text(cell: object) -> str:
    """Returns a cell of a spreadsheet as text."""
    match cell:
        case None:
            return ""
        case bool():
            return "true" if cell else "false"
        case float() if cell.is_integer() and abs(cell) < 1e15:
            return str(int(cell))
        case float():
            return f"{cell:.15g}"  # as Excel shows it, not 0.30000000000000004
        case _:
            return str(cell)
