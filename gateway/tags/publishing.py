"""Publishing of values: on a change or at an interval, and in which form."""

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple


class Publish(StrEnum):
    CHANGE = "change"
    ALWAYS = "always"


class Form(StrEnum):
    """The payload of a published value."""

    JSON = "json"  # with quality and time
    RAW = "raw"  # the bare value


class Deadband(NamedTuple):
    """The least change that is published. `percent`: of the last published value."""

    amount: float
    percent: bool = False


@dataclass(frozen=True, slots=True)
class Publishing:
    """The rules of the published values of a tag."""

    deadband: Deadband | None = None
    publish: Publish = Publish.CHANGE
    heartbeat: float | None = None
    payload: Form = Form.JSON
    history: bool = False
    event: bool = False  # every value is published, also an equal one


ON_CHANGE = Publishing()
