"""Finds the columns of a sheet by their titles, in any order and in the usual spellings."""

import re
import unicodedata
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches

from gateway.config.sheets.cells import data, words

_TEXTS = ("name", "description")  # a second column for these is left out, not refused
# Without another column of addresses this one has them: `Device` is the maker's word for D100.
_ADDRESS_TOO = ("device", "device name", "裝置", "装置")
_NAMES_TOO = ("bezeichnung", "benennung")  # beside a column of names they describe
# A program with this title writes its scan rates in ms.
_IN_MILLISECONDS = ("client access",)
_BRACKETS = re.compile(r"[\[(（]([^\])）]*)[\])）]\s*\Z")
_SEPARATORS = re.compile(r"[\s_\-./\\:()\[\]（）]+")


@dataclass(frozen=True, slots=True)
class Column:
    """A column with a known title. `title` is as written, `index` counts from 0."""

    setting: str
    title: str
    index: int
    unit: str = ""  # in brackets of the title: Interval [ms]

    @property
    def place(self) -> str:
        return f"column {letter(self.index)} ({self.title})"


@dataclass(slots=True)
class Columns:
    """The columns of a sheet by setting, the titles that are not used, and mistakes by index."""

    by_setting: dict[str, Column] = field(default_factory=dict)
    unused: dict[int, str] = field(default_factory=dict)
    mistakes: list[tuple[int, str]] = field(default_factory=list)

    @property
    def of_labels(self) -> bool:
        """True for labels of a PLC program: not each has a name and an address."""
        column = self.by_setting.get("name")
        return column is not None and "label" in column.title.casefold()


def titles_in(cells: Sequence[str]) -> int:
    """Returns the number of cells that are known titles; 0 for a row that cannot be the titles."""
    found = {setting for cell in cells if (setting := _setting(cell, ())[0])}
    return len(found) if len(found) > 1 else 0


def columns_of(cells: Sequence[str], others: Sequence[str]) -> Columns:
    """Returns the columns of the row of titles. `others`: more settings, by their own names."""
    found = Columns()
    ranked = []
    for index, cell in enumerate(cells):
        setting, unit = _setting(cell, others)
        if setting:
            known = list(words("titles"))
            rank = known.index(plain) if (plain := _plain(cell)) in known else len(known)
            ranked.append((rank, Column(setting, cell, index, unit)))
        elif setting is None and cell:
            _note_unknown(found, index, cell, others)
    for _, column in sorted(ranked, key=lambda one: (one[0], one[1].index)):
        first = found.by_setting.setdefault(column.setting, column)
        if first is not column and column.setting in _TEXTS:
            found.unused[column.index] = column.title
        elif first is not column:
            both = f"{first.place} has the same meaning: delete or rename one of them"
            found.mistakes.append((column.index, both))
    _take_other_meanings(found)
    every = found.by_setting.get("every")
    if every and not every.unit and any(_plain(cell) in _IN_MILLISECONDS for cell in cells):
        found.by_setting["every"] = replace(every, unit="ms")
    return found


def _take_other_meanings(found: Columns) -> None:
    """Gives a column the setting that its title also has, where no other column has it."""
    named, address = found.by_setting.get("device"), found.by_setting.get("address")
    if named and _plain(named.title) in _ADDRESS_TOO and (address is None or found.of_labels):
        if address is not None:  # the IEC form of the same
            found.unused[address.index] = address.title
        found.by_setting["address"] = replace(named, setting="address")
        del found.by_setting["device"]
    second = next((at for at, title in found.unused.items() if _plain(title) in _NAMES_TOO), None)
    if second is not None and "description" not in found.by_setting:
        title = found.unused.pop(second)
        found.by_setting["description"] = Column("description", title, second)


def _note_unknown(found: Columns, index: int, title: str, others: Sequence[str]) -> None:
    """A title that is nearly known is a mistake: a misspelt `Scale` would change every value."""
    titles = words("titles")
    close = get_close_matches(_plain(title), [*titles, *others], n=1, cutoff=0.8)
    if close:
        setting = titles.get(close[0], close[0])
        known = next((title for title, one in titles.items() if one == setting), setting)
        found.mistakes.append((index, f"no column of tags: did you mean {known.capitalize()}?"))
    else:
        found.unused[index] = title


def _setting(title: str, others: Sequence[str]) -> tuple[str | None, str]:
    """Returns the setting of a title, and its unit; "" for a column that only informs."""
    plain, titles = _plain(title), words("titles")
    if plain in titles:
        return titles[plain], ""
    if (name := plain.replace(" ", "_")) in others:
        return name, ""
    if match := _BRACKETS.search(title):
        setting = titles.get(_plain(title[: match.start()]))
        return setting, words("times").get(match[1].strip().casefold(), "")
    return None, ""


def _plain(title: str) -> str:
    text = unicodedata.normalize("NFKC", title).casefold()
    return _SEPARATORS.sub(" ", text).strip(" *#")


def unusable(setting: str, cells: Collection[str]) -> str:
    """Returns why a column of `unusable` cannot be left out; empty if its cells change nothing."""
    found, known = {cell.casefold() for cell in cells}, data("words.yaml")
    changes = found - {*known["neutral"].get(setting, found if len(found) == 1 else ())}
    return f"this column cannot be used: {known['unusable'][setting]}" if changes else ""


def letter(index: int) -> str:
    """Returns the letter of a column, as a spreadsheet shows it: A, B … AA."""
    text = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        text = chr(ord("A") + rest) + text
    return text
