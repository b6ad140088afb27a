"""The doors of the plant: what the parts add to it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from gateway.contract.status import Document
from gateway.line.wire_log import WireLog
from gateway.plant.conditions import Conditions
from gateway.plant.write_path import Store
from gateway.tags import Sample, Tag

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
