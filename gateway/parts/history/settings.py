"""The section `history` of the file."""

from os.path import realpath
from pathlib import Path
from typing import Annotated

from gateway.config.settings import parsers
from gateway.config.settings.sections import PartSection, Place, Written
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import FilePath, Interval, Parsed

_TAILS = ("", "-wal", "-shm", "-journal", ".lock")  # SQLite's files, and the lock


class HistorySection(Section):
    """Samples kept on disk, for tags with `history: true`."""

    path: FilePath = Path("history.db")
    """The SQLite file, relative to $STATE_DIRECTORY, else to this file's folder."""
    keep: Interval = 7 * 86400.0
    """Older samples are deleted."""
    max_size: Annotated[
        int, Parsed(parsers.size, {"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)? ?([kKMGT]B)$"})
    ] = 10**9
    """The oldest samples are deleted when the file grows beyond this size."""


def _place(settings: HistorySection | None, place: Place) -> HistorySection | None:
    if settings is None:
        if place.recorded is not None:
            place.mistakes.at(*place.recorded, "history").add(
                "the file has no `history:` section: write `history: {path: history.db}` beside "
                "`lines:`"
            )
        return None
    path = place.written(settings.path)
    if place.state_file is not None and realpath(path) == realpath(place.state_file):
        place.mistakes.at("gateway", "state").add(
            f"history is kept in {settings.path}: two files are needed, such as "
            "history.db and state.json"
        )
    return settings.model_copy(update={"path": path})


def _writes(settings: HistorySection) -> list[Written]:
    return [Written(("history", "path"), settings.path, _TAILS, "history.db")]


SECTION = PartSection(name="history", settings=HistorySection, place=_place, writes=_writes)
