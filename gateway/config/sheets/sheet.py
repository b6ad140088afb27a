"""Rows of a sheet as settings of tags, with the place of everything for messages."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from gateway.config.sheets import cells
from gateway.config.sheets.columns import Column, Columns, columns_of, titles_in, unusable
from gateway.config.sheets.grid import HEADER_ROWS, Grid, Row
from gateway.errors import ConfigError

_NUMBERS = ("scale", "offset", "min", "max", "raw_low", "raw_high", "scaled_low", "scaled_high")
_RANGE = ("raw_low", "raw_high", "scaled_low", "scaled_high")
_PART_OF = {"min": "write", "max": "write", "verify": "write", "length": "type"}
_READERS: dict[str, Callable[[str], object]] = {
    "history": cells.flag,
    "word_order": cells.order,
    "byte_order": cells.order,
    "invert": cells.flag,
    "enum": cells.names,
}
_SCALINGS = ("", "none", "no", "keine", "linear")
_KEPT = 3  # examples in a note
_ASSIGNED = ("<auto>", "auto", "<자동>")  # an address that is only known in the PLC's program


class SheetMistake(NamedTuple):
    """`column`: as in `Column.place`; empty for the whole row."""

    row: int
    column: str
    what: str


@dataclass(slots=True)
class Sheet:
    """The tags of one sheet: settings as the configuration has them, by name."""

    tags: dict[str, dict[str, object]] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)  # by name of the tag
    columns: dict[str, str] = field(default_factory=dict)  # place of each setting
    mistakes: list[SheetMistake] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_sheet(
    grid: Grid, device: str, others: Sequence[str], parse: Callable[[str], object]
) -> Sheet:
    """Returns the tags of a device.

    A sheet with a column `Device` holds the tags of several. `others`: settings that may have a
    column of their own name; `parse` turns their cells into data, and raises `ConfigError`.
    Raises `ConfigError` where the file has no titles.
    """
    header = _header(grid.rows)
    columns = columns_of(header.cells, others)
    reader = _Reader(columns, grid.decimal, header.number, others, parse)
    reader.sheet.notes += grid.project.notes if grid.project else []
    reader.check_columns()
    rows = [row for row in grid.rows if row.number > header.number and _has_tag(row)]
    reader.learn(rows)
    for row in rows:
        reader.add(row, device)
    reader.finish(device)
    return reader.sheet


def devices_in(grid: Grid) -> list[str]:
    """Returns the devices that a sheet names, in their order. Raises `ConfigError`."""
    header = _header(grid.rows)
    column = columns_of(header.cells, ()).by_setting.get("device")
    if column is None:
        return []
    rows = (row for row in grid.rows if row.number > header.number and _has_tag(row))
    return list(dict.fromkeys(cells.name(cell) for row in rows if (cell := _at(row, column))))


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
        column = columns_of(header.cells, ()).by_setting.get("address")
        for row in rows:
            if column and row.number > header.number and column.index < len(row.cells):
                text = row.cells[column.index]
                old = max((one for one in prefixes if text.startswith(one)), key=len, default="")
                row.cells[column.index] = prefixes.get(old, "") + text.removeprefix(old)
    return grid._replace(rows=rows)


def _title(cell: str, settings: Mapping[str, str]) -> str:
    """Returns a title; another column with the meaning of a chosen one loses its own."""
    if cell.casefold() in settings:
        return settings[cell.casefold()]
    meaning = columns_of([cell], ()).by_setting
    return f"not used: {cell}" if meaning.keys() & set(settings.values()) else cell


def _header(rows: Sequence[Row]) -> Row:
    first = [row for row in rows[:HEADER_ROWS] if row.cells]
    if not first:
        raise ConfigError("the sheet is empty: its first row has titles, such as Name and Address")
    best = max(first, key=lambda row: titles_in(row.cells))
    if not titles_in(best.cells):
        seen = ", ".join(cell for cell in first[0].cells if cell)[:80]
        raise ConfigError(
            "no row with titles of columns: the first row needs at least Name and Address, "
            f"as `Name;Address;Type;Unit;Scale`. Row {first[0].number} has: {seen}"
        )
    return best


def _has_tag(row: Row) -> bool:
    """Returns False for empty rows, and rows that begin with # or //."""
    first = next(filter(None, row.cells), "")
    return bool(first) and not first.startswith(("# ", "//")) and first != "#"


@dataclass(slots=True)
class _Reader:
    columns: Columns
    decimal: str | None
    header: int
    others: Sequence[str]
    parse: Callable[[str], object]
    sheet: Sheet = field(default_factory=Sheet)
    renamed: list[str] = field(default_factory=list)
    left: Counter[str] = field(default_factory=Counter)  # rows of tags that need no address
    devices: set[str] = field(default_factory=set)

    def check_columns(self) -> None:
        known = self.columns.by_setting
        for index, what in self.columns.mistakes:
            self._mistake(self.header, what, Column("", "title", index).place)
        if "address" not in known:
            titles = ", ".join(column.title for column in known.values())
            self._mistake(self.header, f"no column Address; the titles are {titles}")
        if "name" not in known and "description" not in known:
            self._mistake(self.header, "no column Name, and no Comment to make names of")
        self.sheet.columns = {setting: column.place for setting, column in known.items()}
        for part, whole in _PART_OF.items():
            if whole not in known and part in known:
                self.sheet.columns[whole] = known[part].place
        if self.columns.unused:
            self.sheet.notes.append(f"columns not used: {', '.join(self.columns.unused.values())}")

    @property
    def _named(self) -> bool:
        """True where each row needs a name; labels may be empty."""
        return "name" in self.columns.by_setting and not self.columns.of_labels

    def _check_names(self, rows: Sequence[Row]) -> None:
        """Without a column of names, one that looks like names must not be left out."""
        known = self.columns.by_setting
        for index, title in () if "name" in known else self.columns.unused.items():
            found = [row.cells[index] for row in rows if index < len(row.cells)]
            texts = {text for text in found if re.search(r"[^\W\d]{2}", text)}
            if len(texts) == len(rows) > 1:
                what = f"names? Then add --columns name={title}; else delete the column"
                self._mistake(self.header, what, Column("", title, index).place)

    def learn(self, rows: Sequence[Row]) -> None:
        """Finds what only all rows together tell: the decimal mark, and the devices."""
        found = (self._cell(row, setting) for row in rows for setting in _NUMBERS)
        self.decimal = self.decimal or cells.decimal_mark(found)
        self._check_names(rows)
        for setting in cells.data("words.yaml")["unusable"]:
            if why := unusable(setting, {self._cell(row, setting) for row in rows}):
                self._mistake(self.header, why, self._place(setting))
        self.devices = {whose for row in rows if (whose := self._cell(row, "device"))}

    def add(self, row: Row, device: str) -> None:
        """Adds the tag of a row, or its mistakes."""
        whose = self._cell(row, "device")
        if not whose and self.devices:
            self._mistake(row.number, "no device, but other rows have one", self._place("device"))
        if whose and cells.name(whose) != device:
            return
        if self._cell(row, "computed"):
            self.left["computed tags left out: write them into the file"] += 1
            return
        address = self._cell(row, "address").casefold()
        if address in _ASSIGNED or (self.columns.of_labels and not address):
            self.left["tags left out: the PLC's program chose their addresses itself"] += 1
            return
        row = self._without_errors(row)
        settings = dict(self._settings(row))
        name = self._name(row, settings)
        for problem in self._missing(row, name):
            self._mistake(row.number, problem)
        if "address" not in settings:
            return
        if name in self.sheet.tags:
            other = self.sheet.rows[name]
            self._mistake(row.number, f"{name} is in row {other} already", self._place("name"))
        if not name or name in self.sheet.tags:
            name = f"{name}_row_{row.number}"  # its other mistakes are reported too
        self.sheet.tags[name] = settings
        self.sheet.rows[name] = row.number

    def _without_errors(self, row: Row) -> Row:
        """Notes the errors of formulas. Returns the row with empty cells in their place."""
        found = list(row.cells)
        for column in self.columns.by_setting.values():
            try:
                cells.check(_at(row, column))
            except ConfigError as error:
                self._mistake(row.number, str(error), column.place)
                found[column.index] = ""
        return Row(row.number, found)

    def finish(self, device: str) -> None:
        self.sheet.notes += [f"{count} {what}" for what, count in self.left.items()]
        if self.renamed:
            examples = ", ".join(self.renamed[:_KEPT])
            more = f" and {len(self.renamed) - _KEPT} more" if len(self.renamed) > _KEPT else ""
            self.sheet.notes.append(f"names changed to what a key can have: {examples}{more}")
        if not self.sheet.tags and not self.sheet.mistakes:
            told = "no row below the titles has a tag"
            if self.devices:
                told = (
                    f"no row is of device {device}: the sheet has {', '.join(sorted(self.devices))}"
                )
            self._mistake(self.header, told)

    def _missing(self, row: Row, name: str) -> Iterator[str]:
        known = self.columns.by_setting
        if "address" in known and not self._cell(row, "address"):
            yield "no address: fill it in, or begin a row that is no tag with #"
        if not name and self._named:
            yield "no name"

    def _name(self, row: Row, settings: dict[str, object]) -> str:
        """Returns the name; without one, the comment or the address makes it."""
        written = self._cell(row, "name")
        if written:
            name = cells.name(written)
            if name != written:
                self.renamed.append(f"{written} -> {name}")
                settings.setdefault("description", written)
            return name
        address = self._cell(row, "address")
        if self._named:
            return ""
        comment = self._cell(row, "description")
        name = cells.name(comment or address)
        return f"{name}_{cells.name(address)}" if name in self.sheet.tags else name

    def _settings(self, row: Row) -> Iterator[tuple[str, object]]:
        """Yields the settings of a tag that the row has."""
        if address := self._cell(row, "address"):
            bit = self._cell(row, "bit")
            place = "bit" if bit else "address"
            for _, spelt in self._one(row, place, partial(cells.address, address, bit)):
                yield "address", spelt
        for setting in ("unit", "description"):
            if text := self._cell(row, setting):
                yield setting, text
        if text := self._cell(row, "type"):
            length = self._cell(row, "length")
            yield from self._one(row, "type", partial(cells.kind, text, length))
        yield from self._scaling(row)
        yield from self._write(row)
        yield from self._timed(row)
        readers = {**_READERS, **dict.fromkeys(self.others, self.parse)}
        for setting, read in readers.items():
            if text := self._cell(row, setting):
                yield from self._one(row, setting, partial(read, text))

    def _timed(self, row: Row) -> Iterator[tuple[str, object]]:
        if text := self._cell(row, "every"):
            unit = self.columns.by_setting["every"].unit
            yield from self._one(row, "every", partial(cells.duration, text, unit))
        if band := self._cell(row, "deadband"):
            yield from self._one(row, "deadband", partial(cells.deadband, band, self.decimal))

    def _scaling(self, row: Row) -> Iterator[tuple[str, object]]:
        values = dict(self._numbers(row, ("scale", "offset", *_RANGE)))
        ends = [values.pop(setting) for setting in _RANGE if setting in values]
        linear = self._cell(row, "scaling").casefold()
        if linear not in _SCALINGS:
            what = f"{linear} is no scaling: write linear, or the factor into a column Scale"
            self._mistake(row.number, what, self._place("scaling"))
        if (not ends and linear != "linear") or linear in ("none", "no", "keine"):
            yield from values.items()
            return
        if len(ends) < 4 or values:
            self._mistake(
                row.number,
                "a range needs its four ends, linear, and no scale beside it: "
                "raw low, raw high, scaled low, scaled high",
            )
            return
        raw_low, raw_high, low, high = ends
        if raw_low == raw_high or low == high:
            self._mistake(row.number, "the two ends of a range are equal")
            return
        scale = (high - low) / (raw_high - raw_low)
        yield "scale", float(f"{scale:.15g}")
        if offset := float(f"{low - raw_low * scale:.12g}"):
            yield "offset", offset

    def _write(self, row: Row) -> Iterator[tuple[str, object]]:
        rules: dict[str, object] = dict(self._numbers(row, ("min", "max")))
        if text := self._cell(row, "verify"):
            rules |= self._one(row, "verify", partial(cells.flag, text))
        if text := self._cell(row, "write"):
            for _, write in self._one(row, "write", partial(cells.access, text)):
                yield "write", (rules or True) if write else False

    def _numbers(self, row: Row, settings: Sequence[str]) -> Iterator[tuple[str, int | float]]:
        for setting in settings:
            if text := self._cell(row, setting):
                try:
                    yield setting, cells.number(text, self.decimal)
                except ConfigError as error:
                    self._mistake(row.number, str(error), self._place(setting))

    def _one(self, row: Row, setting: str, read: Callable[[], object]) -> list[tuple[str, object]]:
        """Returns the setting with its value; nothing after a mistake, or without value."""
        try:
            value = read()
        except ConfigError as error:
            self._mistake(row.number, str(error), self._place(setting))
            return []
        return [] if value is None else [(setting, value)]

    def _cell(self, row: Row, setting: str) -> str:
        column = self.columns.by_setting.get(setting)
        return _at(row, column) if column is not None else ""

    def _place(self, setting: str) -> str:
        column = self.columns.by_setting.get(setting)
        return column.place if column is not None else ""

    def _mistake(self, row: int, what: str, column: str = "") -> None:
        self.sheet.mistakes.append(SheetMistake(row, column, what))


def _at(row: Row, column: Column) -> str:
    return row.cells[column.index] if column.index < len(row.cells) else ""
