"""Sections of the file that belong to parts. Each part declares its own: `SECTION` in `settings`.

They are found by name through `gateway.parts.registry`: this folder imports no part.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path as FilePath
from typing import Any, NamedTuple, cast

from pydantic import create_model

from gateway.config.messages import Mistakes, Path
from gateway.config.settings.model import FileSection
from gateway.config.settings.records import LineConfig
from gateway.config.settings.session_model import Section
from gateway.config.settings.zenoh_records import existing_file
from gateway.tags import Tag

REGISTRY = "gateway.parts.registry"


class Written(NamedTuple):
    """A file that the gateway writes. `tails`: the ends of the names of all its files."""

    setting: Path
    file: FilePath
    tails: Sequence[str]
    example: str  # a name that no other file has


@dataclass(frozen=True, slots=True)
class Place:
    """The parts of the whole file that a section may use. Its mistakes are noted here."""

    mistakes: Mistakes
    folder: FilePath  # of the file
    state_folder: FilePath | None  # for the files that the gateway writes
    state_file: FilePath | None
    lines: Sequence[LineConfig]
    recorded: Path | None  # the first tag with `history: true`
    has_writers: bool  # requests need the signature of a named writer

    @property
    def tags(self) -> Sequence[Tag]:
        return [tag for line in self.lines for tag in line.tags]

    def written(self, name: FilePath) -> FilePath:
        """Returns the path of a file that the gateway writes."""
        return (self.state_folder or self.folder) / name

    def existing(self, name: FilePath | None, *setting: str) -> FilePath | None:
        """Returns the path of a file that must exist."""
        return existing_file(name, self.folder, self.mistakes.at(*setting))


def _same(settings: Any, _place: Place) -> Any:
    return settings


def _none(_settings: Any) -> Any:
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PartSection:
    """The section of one part."""

    name: str
    settings: type[Section]
    always: bool = False  # left out, its defaults count
    # Checks the settings with the rest of the file (None: there is no section), and completes them.
    place: Callable[[Any, Place], Any] = _same
    writes: Callable[[Any], Sequence[Written]] = _none
    reads: Callable[[Any], Sequence[tuple[str, FilePath | None]]] = _none  # setting and file


def part_sections() -> Sequence[PartSection]:
    return cast("Sequence[PartSection]", import_module(REGISTRY).sections())


@cache
def file_section() -> type[FileSection]:
    """Returns the model of the whole file, with the sections of all parts."""
    sections: dict[str, Any] = {
        one.name: (one.settings, one.settings()) if one.always else (one.settings | None, None)
        for one in part_sections()
    }
    return create_model(
        "FileSection", __base__=FileSection, __doc__=FileSection.__doc__, **sections
    )


def placed(file: FileSection, place: Place) -> dict[str, Any]:
    """Returns the settings of all parts that have some, by section."""
    found = {one.name: one.place(getattr(file, one.name), place) for one in part_sections()}
    return {name: settings for name, settings in found.items() if settings is not None}


def writes(parts: Mapping[str, Any]) -> Iterator[Written]:
    for one in part_sections():
        if one.name in parts:
            yield from one.writes(parts[one.name])


def reads(parts: Mapping[str, Any]) -> Iterator[tuple[str, FilePath | None]]:
    for one in part_sections():
        if one.name in parts:
            yield from one.reads(parts[one.name])
