"""Rows of a sheet as settings of tags, with the place of everything for messages."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from gateway.config.settings.parsers import LONGEST_NAME
from gateway.config.sheets import cells
from gateway.config.sheets.columns import Column, Columns, columns_of, unusable
from gateway.config.sheets.grid import Grid, Row
from gateway.config.sheets.layout import parts
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
_OF_OTHERS = "tags of other devices"
_WORD = re.compile(r"[^\W\d]{2}")
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
    header, rows = parts(grid)
    columns = columns_of(header.cells, others)
    reader = _Reader(columns, grid.decimal, header.number, others, parse)
    reader.sheet.notes += grid.project.notes if grid.project else []
    reader.check_columns(rows)
    found = [(row.number, reader.texts(row)) for row in rows]
    reader.learn([texts for _, texts in found])
    for row, texts in found:
        reader.add(row, texts, device)
    reader.finish(device)
    return reader.sheet


Texts = dict[str, str]  # the cells of a row that are not empty, by setting


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

    def texts(self, row: Row) -> Texts:
        cells_, known = row.cells, self.columns.by_setting.items()
        return {
            setting: text
            for setting, column in known
            if column.index < len(cells_) and (text := cells_[column.index])
        }

    def check_columns(self, rows: Sequence[Row]) -> None:
        known, unused = self.columns.by_setting, self.columns.unused
        for index, what in self.columns.mistakes:
            self._mistake(self.header, what, Column("", "title", index))
        if "address" not in known:
            titles = ", ".join(column.title for column in known.values())
            self._mistake(self.header, f"no column Address; the titles are {titles}")
        if "name" not in known and "description" not in known:
            self._mistake(self.header, "no column Name, and no Comment to make names of")
        # Without a column of names, one that looks like names must not be left out.
        for index, title in () if "name" in known else unused.items():
            found = {row.cells[index] for row in rows if index < len(row.cells)}
            if sum(bool(_WORD.search(text)) for text in found) == len(rows) > 1:
                what = f"names? Then add --columns name={title}; else delete the column"
                self._mistake(self.header, what, Column("", title, index))
        self.sheet.columns = {setting: column.place for setting, column in known.items()}
        for part, whole in _PART_OF.items():
            if whole not in known and part in known:
                self.sheet.columns[whole] = known[part].place
        if unused:
            self.sheet.notes.append(f"columns not used: {', '.join(unused.values())}")

    def learn(self, rows: Sequence[Texts]) -> None:
        """Finds what only all rows together tell: the decimal mark, and the devices."""
        numbers = (texts[setting] for texts in rows for setting in _NUMBERS if setting in texts)
        self.decimal = self.decimal or cells.decimal_mark(numbers)
        for setting in cells.data("words.yaml")["unusable"]:
            if why := unusable(setting, {texts.get(setting, "") for texts in rows}):
                self._mistake(self.header, why, setting)
        self.devices = {texts["device"] for texts in rows if "device" in texts}

    def add(self, row: int, texts: Texts, device: str) -> None:
        """Adds the tag of a row, or its mistakes."""
        if why := self._left_out(row, texts, device):
            self.left[why] += 1
            return
        for setting, text in list(texts.items()):
            if self._read(row, setting, cells.check, text) is None:
                del texts[setting]  # the error of a formula
        settings = self._settings(row, texts)
        name = self._name(texts, settings)
        if "address" in self.columns.by_setting and "address" not in texts:
            self._mistake(row, "no address: fill it in, or begin a row that is no tag with #")
        if not name and self._named:
            self._mistake(row, "no name")
        if "address" not in settings:
            return
        if name in self.sheet.tags:
            self._mistake(row, f"{name} is in row {self.sheet.rows[name]} already", "name")
        if not name or name in self.sheet.tags:
            name = f"{name}_row_{row}"  # its other mistakes are reported too
        self.sheet.tags[name] = settings
        self.sheet.rows[name] = row

    def _left_out(self, row: int, texts: Texts, device: str) -> str:
        """Returns why a row is no tag of the device; empty for a tag."""
        whose, address = texts.get("device"), texts.get("address", "").casefold()
        if not whose and self.devices:
            self._mistake(row, "no device, but other rows have one", "device")
        if whose and cells.name(whose) != device:
            return _OF_OTHERS
        if "computed" in texts:
            return "computed tags left out: write them into the file"
        if address in _ASSIGNED or (self.columns.of_labels and not address):
            return "tags left out: the PLC's program chose their addresses itself"
        return ""

    def finish(self, device: str) -> None:
        del self.left[_OF_OTHERS]
        self.sheet.notes += [f"{count} {what}" for what, count in self.left.items()]
        if self.renamed:
            examples = ", ".join(self.renamed[:_KEPT])
            more = f" and {len(self.renamed) - _KEPT} more" if len(self.renamed) > _KEPT else ""
            self.sheet.notes.append(f"names changed to what a key can have: {examples}{more}")
        if not self.sheet.tags and not self.sheet.mistakes:
            has = ", ".join(sorted(self.devices))
            told = f"no row is of device {device}: the sheet has {has}" if has else ""
            self._mistake(self.header, told or "no row below the titles has a tag")

    @property
    def _named(self) -> bool:
        """True where each row needs a name; labels may be empty."""
        return "name" in self.columns.by_setting and not self.columns.of_labels

    def _name(self, texts: Texts, settings: dict[str, object]) -> str:
        """Returns the name; without one, the comment or the address makes it."""
        if written := texts.get("name"):
            if (name := cells.name(written)) != written:
                self.renamed.append(f"{written} -> {name}")
                settings.setdefault("description", written)
            return name
        if self._named:
            return ""
        address = texts.get("address", "")
        name = cells.name(texts.get("description") or address)
        if len(name.encode()) > LONGEST_NAME:
            name = cells.name(address)
        return f"{name}_{cells.name(address)}" if name in self.sheet.tags else name

    def _settings(self, row: int, texts: Texts) -> dict[str, object]:
        """Returns the settings of a tag that the row has."""
        bit, every = texts.get("bit", ""), self.columns.by_setting.get("every")
        readers: dict[str, Callable[[str], object]] = {
            "address": lambda text: cells.address(text, bit),
            "unit": str,
            "description": str,
            "type": lambda text: cells.kind(text, texts.get("length", "")),
            **dict.fromkeys(_NUMBERS, lambda text: cells.number(text, self.decimal)),
            "verify": cells.flag,
            "write": cells.access,
            "every": lambda text: cells.duration(text, every.unit if every else ""),
            "deadband": lambda text: cells.deadband(text, self.decimal),
            **_READERS,
            **dict.fromkeys(self.others, self.parse),
        }
        found: dict[str, Any] = {}
        for setting, read in readers.items():
            if text := texts.get(setting):
                place = "bit" if setting == "address" and bit else setting
                if (value := self._read(row, place, read, text)) is not None:
                    found[setting] = value
        if why := _scale(found, texts.get("scaling", "").casefold()):
            self._mistake(row, why[0], why[1])
        rules = {name: found.pop(name) for name in ("min", "max", "verify") if name in found}
        if found.get("write"):
            found["write"] = rules or True
        return found

    def _read(self, row: int, setting: str, read: Callable[[str], object], text: str) -> object:
        """Returns the value of a cell; None after a mistake."""
        try:
            return read(text)
        except ConfigError as error:
            self._mistake(row, str(error), setting)
            return None

    def _mistake(self, row: int, what: str, at: str | Column = "") -> None:
        column = self.columns.by_setting.get(at) if isinstance(at, str) else at
        self.sheet.mistakes.append(SheetMistake(row, column.place if column else "", what))


def _scale(found: dict[str, Any], scaling: str) -> tuple[str, str] | None:
    """Makes scale and offset of a range. Returns a mistake, and the setting it is in."""
    ends = [found.pop(setting) for setting in _RANGE if setting in found]
    if scaling not in _SCALINGS:
        return (
            f"{scaling} is no scaling: write linear, or the factor into a column Scale",
            "scaling",
        )
    if (not ends and scaling != "linear") or scaling in ("none", "no", "keine"):
        return None
    if len(ends) < 4 or found.keys() & {"scale", "offset"}:
        return (
            "a range needs its four ends, linear, and no scale beside it: "
            "raw low, raw high, scaled low, scaled high"
        ), ""
    raw_low, raw_high, low, high = ends
    if raw_low == raw_high or low == high:
        return "the two ends of a range are equal", ""
    scale = (high - low) / (raw_high - raw_low)
    found["scale"] = float(f"{scale:.15g}")
    if offset := float(f"{low - raw_low * scale:.12g}"):
        found["offset"] = offset
    return None
