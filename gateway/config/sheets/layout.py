"""The places of titles, tags and devices in a sheet, and the options of a user for them."""

import re
from collections.abc import Mapping, Sequence

from gateway.config.sheets import cells
from gateway.config.sheets.columns import columns_of, titles_in
from gateway.config.sheets.grid import HEADER_ROWS, Grid, Row
from gateway.errors import ConfigError

_REMARK = re.compile(r"# |//|#\Z")


def devices_in(grid: Grid) -> list[str]:
    """Returns the devices that a sheet names, in their order. Raises `ConfigError`."""
    header, rows = parts(grid)
    if (column := columns_of(header.cells, ()).by_setting.get("device")) is None:
        return []
    found = (row.cells[column.index] for row in rows if column.index < len(row.cells))
    return list(dict.fromkeys(cells.name(cell) for cell in found if cell))


def adapted(grid: Grid, titles: Mapping[str, str], prefixes: Mapping[str, str]) -> Grid:
    """Returns the sheet with settings as titles, and other beginnings of addresses.

    `titles`: the title of each such setting. Raises `ConfigError` where no row has them all.
    """
    rows, settings = list(grid.rows), {title.casefold(): name for name, title in titles.items()}
    if titles:
        for at, row in enumerate(rows[:HEADER_ROWS]):
            if settings.keys() <= {cell.casefold() for cell in row.cells}:
                rows[at] = Row(row.number, [_title(cell, settings) for cell in row.cells])
                break
        else:
            raise ConfigError(f"no row has the titles {', '.join(titles.values())}")
    if prefixes:
        header = _header(rows)
        found = columns_of(header.cells, ()).by_setting.get("address")
        index = len(header.cells) if found is None else found.index
        for row in rows:
            text = row.cells[index] if index < len(row.cells) else ""
            old = max((one for one in prefixes if text.startswith(one)), key=len, default="")
            if old and row.number > header.number:
                row.cells[index] = prefixes[old] + text.removeprefix(old)
    return grid._replace(rows=rows)


def _title(cell: str, settings: Mapping[str, str]) -> str:
    """Returns a title; another column with the meaning of a chosen one loses its own."""
    if cell.casefold() in settings:
        return settings[cell.casefold()]
    meaning = columns_of([cell], ()).by_setting
    return f"not used: {cell}" if meaning.keys() & set(settings.values()) else cell


def parts(grid: Grid) -> tuple[Row, list[Row]]:
    """Returns the row of titles, and those of tags: not empty, and without # or // first."""
    header = _header(grid.rows)
    rows = [row for row in grid.rows if row.number > header.number and any(row.cells)]
    return header, [row for row in rows if not _REMARK.match(next(filter(None, row.cells)))]


def _header(rows: Sequence[Row]) -> Row:
    first = [row for row in rows[:HEADER_ROWS] if row.cells]
    if not first:
        raise ConfigError("the sheet is empty: its first row has titles, such as Name and Address")
    best = max(first, key=lambda row: titles_in(row.cells))
    if not titles_in(best.cells):
        seen = ", ".join(cell for cell in first[0].cells if cell)[:80]
        raise ConfigError(
            "no row with titles of columns: the first row needs Address, and Name or Comment, "
            f"as `Name;Address;Type;Unit;Scale`. Row {first[0].number} has: {seen}"
        )
    return best
