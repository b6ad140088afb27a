"""Files of spreadsheet programs as rows of texts: .xlsx, .xls and .ods.

Each reader keeps the errors of formulas: a scale that is `#N/A` must be refused, not be left out.
"""

import io
import struct
import zlib
from collections.abc import Iterable, Iterator
from importlib import import_module
from typing import Any
from xml.etree import ElementTree as ET
from zipfile import BadZipFile, ZipFile

from gateway.errors import ConfigError

_MOST_BYTES = 200_000_000  # of a file in the archive, when it is unpacked
_MOST_ROWS = 200_000
_MOST_COLUMNS = 1_000
_NAMESPACES = "urn:oasis:names:tc:opendocument:xmlns:"
_TABLE = f"{{{_NAMESPACES}table:1.0}}"
_OFFICE = f"{{{_NAMESPACES}office:1.0}}"
_TEXT = f"{{{_NAMESPACES}text:1.0}}"
# What the readers raise where bytes of the file are wrong.
_DAMAGED = (
    *(BadZipFile, zlib.error, EOFError, NotImplementedError, OSError, SyntaxError, struct.error),
    *(ValueError, KeyError, IndexError, TypeError, AttributeError, AssertionError),
)

Table = Iterable[Iterable[object]]


def tables_of(data: bytes) -> list[list[list[object]]]:
    """Returns the tables of a file with their rows and cells. Raises `ConfigError`."""
    kind, read = (".xls", _xls) if data.startswith(b"\xd0\xcf\x11\xe0") else (".xlsx", _xlsx)
    try:
        if kind == ".xlsx" and _is_ods(data):
            kind, read = ".ods", _ods
        found: list[list[list[object]]] = []
        for table in read(data):
            found.append([])
            for row in table:
                found[-1].append(list(row)[:_MOST_COLUMNS])
                if len(found[-1]) > _MOST_ROWS:
                    raise ConfigError(f"a table has more than {_MOST_ROWS} rows")
    except _DAMAGED as error:
        raise ConfigError(f"the file is no {kind} file, or damaged: {error}") from None
    return found


def _reader(kind: str, command: str) -> Any:
    try:
        return import_module(command.split()[-1])
    except ImportError:
        need = f"an {kind} file needs one more package: {command}, or save it as CSV"
        raise ConfigError(need) from None


def _is_ods(data: bytes) -> bool:
    with ZipFile(io.BytesIO(data)) as archive:
        if any(one.file_size > _MOST_BYTES for one in archive.infolist()):
            raise ConfigError(f"the archive holds a file of more than {_MOST_BYTES // 10**6} MB")
        return "content.xml" in archive.namelist()


def _xlsx(data: bytes) -> Iterator[Table]:
    options = {"read_only": True, "data_only": True}
    book = _reader(".xlsx", "pip install openpyxl").load_workbook(io.BytesIO(data), **options)
    for name in book.sheetnames:
        book[name].reset_dimensions()  # some programs write a wrong size
        yield book[name].iter_rows(values_only=True)


def _xls(data: bytes) -> Iterator[Table]:
    xlrd = _reader(".xls", "pip install xlrd")
    try:
        book = xlrd.open_workbook(file_contents=data, logfile=io.StringIO())
    except (xlrd.XLRDError, xlrd.compdoc.CompDocError) as error:
        raise ValueError(error) from None
    special = {
        xlrd.XL_CELL_BOOLEAN: bool,
        xlrd.XL_CELL_ERROR: lambda code: xlrd.error_text_from_code.get(code, "#N/A"),
    }
    for sheet in book.sheets():
        rows = (sheet.row(number) for number in range(sheet.nrows))
        yield ([special.get(cell.ctype, _same)(cell.value) for cell in row] for row in rows)


def _same(value: object) -> object:
    return value


def _ods(data: bytes) -> Iterator[Table]:
    with ZipFile(io.BytesIO(data)) as archive:
        tree = ET.fromstring(archive.read("content.xml"))  # noqa: S314  # expat bounds entities
    for table in tree.iter(f"{_TABLE}table"):
        yield _rows(table)


def _rows(table: Any) -> Iterator[list[object]]:
    for row in table.iter(f"{_TABLE}table-row"):
        cells: list[object] = []
        for cell in row:
            count = int(cell.get(f"{_TABLE}number-columns-repeated", "1"))
            cells += [_cell(cell)] * min(count, _MOST_COLUMNS)
        count = int(row.get(f"{_TABLE}number-rows-repeated", "1"))
        yield from [cells] * (min(count, _MOST_ROWS + 1) if any(cells) else min(count, _MOST_EMPTY))


_MOST_EMPTY = 1_000  # rows in a row: a file ends with a million of them


def _cell(cell: Any) -> object:
    match cell.get(f"{_OFFICE}value-type"):
        case "float" | "percentage" | "currency":
            return float(cell.get(f"{_OFFICE}value"))
        case "boolean":
            return cell.get(f"{_OFFICE}boolean-value") == "true"
        case _:
            return " ".join("".join(part.itertext()) for part in cell.iter(f"{_TEXT}p"))
