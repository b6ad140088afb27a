"""The text that the file is going to have: each step changes it, and the file only when applied."""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gateway import files
from gateway.cli.config.check import size
from gateway.cli.config.new import NamedStation, head_text, line_text
from gateway.cli.sheets.import_command import with_sheet
from gateway.cli.sheets.text_file import BOM
from gateway.config import Config, ConfigErrors, load
from gateway.config.settings import parsers
from gateway.config.sheets import Grid, adapted, devices_in, read_grid
from gateway.config.sheets.columns import columns_of, letter
from gateway.config.sheets.grid import Row
from gateway.config.sheets.layout import parts
from gateway.config.sheets.tags import other_settings
from gateway.config.yaml.insert import Settings, entry, with_block, with_tags
from gateway.errors import ConfigError
from gateway.parts.transfers.forecast import forecasts
from gateway.protocols.driver import Address, AnyDriver, Unit

_MOST_STEPS = 200  # that can be taken back
_MOST_SHOWN = 400  # lines of a difference
_FIRST_ROWS = 8  # of a sheet
_ROWS = 32  # addresses of a first look
_DAY = "named at the bench"


class Draft:
    """The text under work. `file`: the content of FILE when it was read last; None: there is none.

    Every method may block: a file may be large, or on a network disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file: bytes | None = None
        self.text = ""
        self._before: list[str] = []
        self._loaded: tuple[str, Config] | None = None
        self._shown: tuple[str, bytes | None, dict[str, Any]] | None = None
        self.read()

    def read(self) -> None:
        """Reads FILE, and drops what was not applied. Raises `ConfigError`."""
        try:
            self.file = files.read(self.path)
        except FileNotFoundError:
            self.file = None
        except OSError as error:
            raise ConfigError(f"{self.path} cannot be read: {error.strerror}") from None
        self.text = _text(self.file)
        self._before.clear()
        self._loaded = None

    def back(self) -> None:
        """Takes the last step back."""
        if self._before:
            self.text = self._before.pop()

    def config(self) -> Config:
        """Raises `ConfigErrors`."""
        if self._loaded is None or self._loaded[0] != self.text:
            self._loaded = (self.text, load(self.path, text=self.text))
        return self._loaded[1]

    @property
    def is_new(self) -> bool:
        return self.text != _text(self.file)

    def add_line(
        self,
        gateway: str,
        line: str,
        port: str,
        devices: Sequence[NamedStation],
        listen: str,
        *,
        simulated: bool,
    ) -> None:
        """Adds a line with its stations. Raises `ConfigError`."""
        block = line_text(parsers.name(line), port, devices, simulated=simulated)
        if self.text.strip():
            text = with_block(str(self.path), self.text, ["lines"], block)
        else:
            text = head_text(parsers.name(gateway), listen=listen) + block
        self._put(text)

    def add_tags(self, device: str, tags: Mapping[str, Settings]) -> None:
        """Raises `ConfigError` for a tag that the file cannot have."""
        for name in tags:
            parsers.name(name)
        self._put(with_tags(str(self.path), self.text, device, tags, _DAY))

    def add_sheet(self, name: str, data: bytes, device: str, columns: Mapping[str, str]) -> int:
        """Adds the tags of a sheet; returns their number. Raises `ConfigErrors`."""
        text, tags = self._with_sheet(name, data, device, columns)
        self._put(text)
        return len(tags)

    def sheet(
        self, name: str, data: bytes, device: str, columns: Mapping[str, str]
    ) -> dict[str, Any]:
        """Returns the columns of a sheet with the settings that they mean, its first rows, and the
        tags that it would add. `columns`: the title of each setting that was chosen. Raises
        `ConfigError` where the file is no sheet."""
        grid = read_grid(data)
        header = _titles(grid)
        settings = columns_of(header.cells, other_settings()).by_setting.values()
        known = {column.index: column.setting for column in settings}
        chosen = {title: setting for setting, title in columns.items()}
        displaced = {at: "" for at, setting in known.items() if setting in columns}
        rows = [row.cells for row in grid.rows if row.number > header.number and any(row.cells)]
        shown: dict[str, Any] = {
            "columns": [
                {
                    "letter": letter(at),
                    "title": title,
                    "setting": chosen.get(title, {**known, **displaced}.get(at, "")),
                }
                for at, title in enumerate(header.cells)
            ],
            "rows": rows[:_FIRST_ROWS],
            "count": len(rows),
            "tags": [],
            "mistakes": [],
        }
        try:
            _, tags = self._with_sheet(name, data, device, columns)
            shown["tags"] = [entry(*one) for one in tags[:_FIRST_ROWS]]
            shown["count"] = len(tags)
        except ConfigErrors as error:
            shown["mistakes"] = [*error.messages]
        except ConfigError as error:
            shown["mistakes"] = [str(error)]
        return shown

    def _with_sheet(
        self, name: str, data: bytes, device: str, columns: Mapping[str, str]
    ) -> tuple[str, list[tuple[str, Settings]]]:
        grid: Grid = adapted(read_grid(data), columns, {})
        devices = devices_in(grid) or [device]
        text, uses = with_sheet(self.path, self.text, Path(name), grid, devices)
        return text, [row for use in uses for row in use.raw.items()]

    def document(self) -> dict[str, Any]:
        """Returns the difference, mistakes, loads and devices, for the page."""
        if self._shown is None or self._shown[:2] != (self.text, self.file):
            self._shown = (self.text, self.file, self._made())
        return {**self._shown[2], "steps": len(self._before)}

    def _made(self) -> dict[str, Any]:
        old, new = (text.splitlines() for text in (_text(self.file), self.text))
        difference = [*difflib.unified_diff(old, new, lineterm="", n=2)][2:]
        shown: dict[str, Any] = {
            "exists": self.file is not None,
            "changed": self.is_new,
            "difference": difference[:_MOST_SHOWN],
            "more": max(0, len(difference) - _MOST_SHOWN),
            "mistakes": [],
            "size": "",
            "lines": [],
            "devices": [],
        }
        if not self.text.strip():
            return shown
        try:
            config = self.config()
        except ConfigErrors as error:
            return {**shown, "mistakes": [*error.messages]}
        before = _loads(self.path, _text(self.file))
        return {
            **shown,
            "size": size(config),
            "lines": [
                {
                    "line": one.name,
                    "load": one.load,
                    "before": before.get(one.name),
                    "requests": one.requests,
                    "advice": one.advice(),
                }
                for one in forecasts(config)
            ],
            "devices": [
                {
                    "device": device.name,
                    "line": line.name,
                    "protocol": device.driver.protocol,
                    "station": device.driver.station,
                    "range": first_look(device.driver),
                    "tags": len(device.tags),
                }
                for line in config.lines
                if not line.serve
                for device in line.devices
            ],
        }

    def _put(self, text: str) -> None:
        """Takes a step. Raises `ConfigErrors` if it would make the file bad."""
        load(self.path, text=text)
        self._before = [*self._before[1 - _MOST_STEPS :], self.text]
        self.text = text


def largest_area(driver: AnyDriver) -> str:
    """Returns the readable area with the most words, or the most bits where it has no words."""
    readable = [area for area in driver.areas.values() if area.readable]
    return max(readable, key=lambda area: (area.unit is Unit.WORD, area.last - area.first)).name


def first_look(driver: AnyDriver) -> str:
    """Returns a range to look at first: `D0..D31`."""
    if not driver.areas:
        return ""
    area = driver.areas[largest_area(driver)]
    ends = area.first, min(area.last, area.first + _ROWS - 1)
    return "..".join(driver.spell(Address(area.name, number)) for number in ends)


def _text(data: bytes | None) -> str:
    try:
        return (data or b"").removeprefix(BOM).decode()
    except UnicodeDecodeError:
        raise ConfigError("the file is no UTF-8") from None


def _loads(path: Path, text: str) -> dict[str, float]:
    try:
        return {one.name: one.load for one in forecasts(load(path, text=text))}
    except ConfigErrors:
        return {}


def _titles(grid: Grid) -> Row:
    """Returns the row of titles; the first one where none has a known title."""
    try:
        return parts(grid)[0]
    except ConfigError:
        first = next((row for row in grid.rows if any(row.cells)), None)
        if first is None:
            raise
        return first
