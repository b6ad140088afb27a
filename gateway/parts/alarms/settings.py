"""The section `alarms` of the file."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Discriminator
from pydantic import Tag as Choice

from gateway.config.settings.sections import PartSection, Place, Written
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Duration, FilePath
from gateway.tags import AlarmRule


class WatchedSection(Section):
    """Alarms without a limit: of devices, lines, transfers or the gateway."""

    priority: Literal["critical", "high", "medium", "low"] | None = None
    """The priority: how soon an operator must act; left out: critical of lines, high of devices,
    medium of transfers; of the gateway it depends on the fault."""
    delay: Duration | None = None
    """It is an alarm after so long; left out: 0 s of devices, 10 s of the gateway, 3 s of
    others."""
    off_delay: Duration = 5.0
    """It is an alarm until it works for so long."""


def _shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, WatchedSection)) else "flag"


Watched = Annotated[
    Annotated[WatchedSection, Choice("rule")] | Annotated[bool, Choice("flag")],
    Discriminator(_shape),
]


class AlarmsSection(Section):
    """The alarms of the gateway."""

    path: FilePath | None = None
    """Keeps alarms across restarts; left out: alarms.json in $STATE_DIRECTORY, or beside this file
    if a tag has an alarm."""
    devices: Watched = True
    """A device that does not reply is an alarm."""
    lines: Watched = True
    """A line that is down is an alarm."""
    transfers: Watched = True
    """A transfer that does not work is an alarm."""
    gateway: Watched = True
    """A fault of the gateway itself is an alarm, such as a full disk or a lost router."""
    shelve_at_most: Duration = 86400.0
    """The longest time that an operator may shelve an alarm."""


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
