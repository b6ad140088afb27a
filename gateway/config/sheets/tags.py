"""Tags of devices that are kept in sheets: `tags_from: tags.csv`."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import NamedTuple

from gateway import files
from gateway.config.messages import Mistakes, Path, dotted, one_of
from gateway.config.settings.validate import settings_of
from gateway.config.sheets import Grid, Sheet, link_table, read_grid, read_sheet
from gateway.config.tags.device_tags import DeviceTags
from gateway.config.tags.section import TagDefaults, TagSection
from gateway.config.yaml.events import plain_data
from gateway.errors import ConfigError
from gateway.protocols.capabilities import NamesRegisters
from gateway.protocols.driver import Addressing
from gateway.tags import Tag
from gateway.tags.tag import NotReal


class SheetUse(NamedTuple):
    """A device and the sheet of its tags; `raw` has their settings as the file would have them."""

    device: str
    file: FilePath
    raw: Mapping[str, Mapping[str, object]]
    notes: tuple[str, ...]


@dataclass(slots=True)
class SheetPlaces:
    """The rows and columns of a sheet, for messages."""

    name: str
    sheet: Sheet
    is_project: bool = False

    def line(self, path: Path) -> int:
        """Returns the row of the tag at `path`: its name, then a setting."""
        return self.sheet.rows.get(str(path[0]), 0) if path else 0

    def at(self, line: int, path: Path) -> str:
        places = (self.sheet.columns.get(str(chunk)) for chunk in reversed(path[1:]))
        column = next(filter(None, places), dotted(path[1:]))
        return self.place(line, column)

    def place(self, line: int, column: str) -> str:
        """Returns the place of a mistake; the tags of a project have numbers, and no columns."""
        if self.is_project:
            column = column.partition("(")[2].rstrip(")")
        unit = "tag" if self.is_project else "row"
        return f"{self.name}: {unit} {line}{', ' if column else ''}{column}: "


@dataclass(slots=True)
class SheetTags:
    """Reads the sheets of a file, each once. `tags` builds the tags of the file itself."""

    folder: FilePath
    used: list[SheetUse] = field(default_factory=list)
    recorded: Path | None = None  # as in `DeviceTags`
    grids: dict[FilePath, Grid | None] = field(default_factory=dict)  # those that were read

    def build(
        self,
        device: str,
        file: FilePath,
        to: Mistakes,
        defaults: TagDefaults,
        driver: Addressing | None,
        taken: Collection[str],
        *,
        not_real: NotReal | None = None,
    ) -> tuple[Tag, ...]:
        """Returns the tags of a device in a sheet. `to`: of the setting that names the sheet."""
        grid = self._grid(self.folder / file, to)
        if grid is None:
            return ()
        try:
            if driver is not None and link_table.is_table(grid):
                grid = link_table.of_station(grid, driver.station, native(driver))
            sheet = read_sheet(grid, device, other_settings(), parsed)
        except ConfigError as error:
            to.add(f"{file}: {error}")
            return ()
        mistakes = _mistakes(file, sheet, grid)
        for name in sheet.tags.keys() & taken:
            mistakes.add(f"{name} is in `tags` of {device} already", name, "name")
        builder = DeviceTags()
        tags = builder.build(device, sheet.tags, mistakes, defaults, driver, not_real=not_real)
        if builder.recorded is not None and self.recorded is None:
            self.recorded = to.path
        to.include(mistakes)
        self.used.append(SheetUse(device, self.folder / file, sheet.tags, tuple(sheet.notes)))
        return tags

    def _grid(self, file: FilePath, to: Mistakes) -> Grid | None:
        if file not in self.grids:
            self.grids[file] = None
            try:
                self.grids[file] = read_grid(files.read(file))
            except ConfigError as error:
                to.add(f"{file.name}: {error}")
            except OSError as error:
                to.add(f"{file} cannot be read: {error.strerror}")
        return self.grids[file]


def native(driver: object) -> Callable[[str], str]:
    """Returns the function from an address of a Modbus table to that of the device."""

    def named(address: str) -> str:
        table, colon, number = address.partition(":")
        if not colon or not isinstance(driver, NamesRegisters):
            return address
        return driver.named(table, int(number))

    return named


def preview(
    file: FilePath, grid: Grid, device: str
) -> tuple[Mapping[str, Mapping[str, object]], list[str]]:
    """Returns the tags of a sheet without knowing their device, and notes.

    Raises `ConfigErrors` with the mistakes that need no device.
    """
    if link_table.is_table(grid):
        raise ConfigError(
            f"{file} is a communication table: name the file with --into, whose devices tell which "
            "station is which"
        )
    sheet = read_sheet(grid, device, other_settings(), parsed)
    mistakes = _mistakes(file, sheet, grid)
    DeviceTags().build(device, sheet.tags, mistakes, TagDefaults(), None)
    mistakes.raise_all()
    return sheet.tags, sheet.notes


def _mistakes(file: FilePath, sheet: Sheet, grid: Grid) -> Mistakes:
    name = file.name if file.is_absolute() else str(file)
    places = SheetPlaces(name, sheet, grid.project is not None)
    mistakes = Mistakes(places)
    for row, column, what in sheet.mistakes:
        mistakes.add_at(row, places.place(row, column), what)
    return mistakes


def other_settings() -> list[str]:
    """Returns the settings of a tag that a column may have under their own names."""
    own = {"address", "type", "unit", "description", "scale", "offset", "every", "deadband"}
    own |= {"word_order", "byte_order", "history", "write", "enum", "invert"}
    own.add("computed")
    return [name for name in settings_of(TagSection) if name not in own]


def parsed(text: str) -> object:
    """Returns the data of a cell as of a setting in YAML: `2`, `true`, `{0: off, 1: auto}`."""
    data = plain_data(f"cell: {text}".encode(), frozenset())
    if data is None:
        raise ConfigError(f"{text!r} is no value as the file has them, such as {_LIKE}")
    return data["cell"]


_LIKE = one_of(("30s", "true", "{0: idle, 1: runs}"))
