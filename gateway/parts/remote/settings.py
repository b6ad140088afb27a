"""The section `remote` of the file: who may give this gateway another file."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from gateway.config.settings.sections import PartSection, Place, Written
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import FilePath, Interval, Text

LONGEST_WAIT = 86400.0  # seconds


class RemoteSection(Section):
    """Files of named writers over Zenoh: docs/remote.md."""

    writers: Annotated[list[Text], Field(min_length=1, description="names of the writers file")]
    confirm: Annotated[Interval, Field(description="then an unconfirmed file goes back")] = 600.0
    keep: Annotated[int, Field(ge=1, le=100, description="earlier files that are kept")] = 10
    path: FilePath = Path("remote.json")


def _place(settings: RemoteSection | None, place: Place) -> RemoteSection | None:
    if settings is None:
        return None
    if not place.has_writers:
        text = "it needs writers: {file: writers.txt}: a file must have the signature of a writer"
        place.mistakes.add(text, "remote", "writers")
    if settings.confirm > LONGEST_WAIT:
        place.mistakes.add("it is longer than a day", "remote", "confirm")
    return settings.model_copy(update={"path": place.written(settings.path)})


def _writes(settings: RemoteSection) -> list[Written]:
    return [Written(("remote", "path"), settings.path, ("", ".new", ".bad"), "remote.json")]


SECTION = PartSection(name="remote", settings=RemoteSection, place=_place, writes=_writes)
