"""The doors of the plant: what the parts add to it.

Among it are conditions that are faults of their own, such as a line that is down or a silent
device. The alarms judge them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.contract.status import Document
from gateway.line.wire_log import WireLog
from gateway.plant.write_path import Store
from gateway.tags import AlarmRule, Sample, Tag


class Reading(NamedTuple):
    """The present state of a condition. `alarm`: 0 or False: it is none; None: it is not known."""

    alarm: float | None
    why: str = ""  # one sentence for people, or empty


class Condition(NamedTuple):
    """One condition: when it is an alarm, and its present state. `parent`: the alarm of the cause,
    of which it is a part while that one is active."""

    rule: AlarmRule
    look: Callable[[], Reading]
    parent: str = ""


class Conditions:
    """The conditions of all owners, by the key of their alarm. Belongs to the event loop."""

    def __init__(self) -> None:
        self._by_owner: dict[str, dict[str, Condition]] = {}
        self.version = 0  # grows with each change

    def put(self, owner: str, conditions: dict[str, Condition]) -> None:
        """Takes the place of all earlier conditions of the owner."""
        self._by_owner[owner] = conditions
        self.version += 1

    def all(self) -> dict[str, Condition]:
        return {key: one for found in self._by_owner.values() for key, one in found.items()}


Documents = Mapping[str, Document]


def _ignore(tags: Sequence[Tag], gone: Sequence[Tag]) -> None:
    """No part follows the tags."""


@dataclass(slots=True)
class Doors:
    """Everything that parts add. Belongs to the event loop."""

    documents: list[Callable[[], Documents]] = field(default_factory=list)  # in the status
    # Called with all samples that the mirror has stored, and with tags that came and went.
    seers: Sequence[Callable[[Sequence[Sample]], None]] = ()
    retagged: Callable[[Sequence[Tag], Sequence[Tag]], None] = _ignore
    conditions: Conditions = field(default_factory=Conditions)
    stores: list[Store] = field(default_factory=list)
    logs: list[Callable[[], Mapping[str, WireLog]]] = field(default_factory=list)
    is_restored: bool = False  # what was learned before the start is known
