"""The section `alarms` of the file."""

from pathlib import Path

from gateway.config.settings.sections import PartSection, Place, Written
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import FilePath
from gateway.tags import AlarmRule


class AlarmsSection(Section):
    """The alarms of the gateway."""

    path: FilePath | None = None
    """Keeps alarms across restarts; left out: alarms.json in $STATE_DIRECTORY, or beside this file
    if a tag has an alarm."""
    devices: bool = True
    """A device that does not reply is an alarm."""
    lines: bool = True
    """A line that is down is an alarm."""
    transfers: bool = True
    """A transfer that does not work is an alarm."""


def _place(settings: AlarmsSection, place: Place) -> AlarmsSection:
    path = settings.path
    has_alarms = any(tag.feature(AlarmRule) is not None for tag in place.tags)
    if path is None and (place.state_folder is not None or has_alarms):
        path = Path("alarms.json")
    return settings.model_copy(update={"path": None if path is None else place.written(path)})


def _writes(settings: AlarmsSection) -> list[Written]:
    tails = ("", ".new", ".bad")
    file = settings.path
    return [] if file is None else [Written(("alarms", "path"), file, tails, "alarms.json")]


SECTION = PartSection(
    name="alarms", settings=AlarmsSection, always=True, place=_place, writes=_writes
)
