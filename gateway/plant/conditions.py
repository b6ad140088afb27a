"""The conditions of the plant that are faults of their own: a line that is down, a silent device.

Parts add theirs; the alarms judge them.
"""

from collections.abc import Callable, Container
from typing import NamedTuple

from gateway.tags import AlarmRule


class Reading(NamedTuple):
    """The present state of a condition. `alarm`: None if it is not known."""

    alarm: bool | None
    why: str = ""  # one sentence for people, or empty


class Condition(NamedTuple):
    """One condition: when it is an alarm, and its present state."""

    rule: AlarmRule
    look: Callable[[], Reading]


class Conditions:
    """The conditions of all owners, by the key of their alarm. Belongs to the event loop."""

    def __init__(self) -> None:
        self._by_owner: dict[str, dict[str, Condition]] = {}
        self.version = 0  # grows with each change

    def put(self, owner: str, conditions: dict[str, Condition]) -> None:
        """Takes the place of all earlier conditions of the owner."""
        self._by_owner[owner] = conditions
        self.version += 1

    def all(self, without: Container[str] = ()) -> dict[str, Condition]:
        """`without`: owners whose conditions are left out."""
        wanted = (found for owner, found in self._by_owner.items() if owner not in without)
        return {key: one for found in wanted for key, one in found.items()}
