"""Counts how often a PLC has carried out the writes of a tag, and what their ends claim."""

import re
from collections.abc import Iterable, Sequence

from gateway.tags import Tag
from gateway.values import Value
from tests.sim.stations import Troubled

CLAIM = " is in the PLC"


TARGETS = ("t0", "t1", "t2")  # of transfers


def written_by_clients(tags: Iterable[Tag]) -> list[Tag]:
    """Returns the tags that can be written, without the targets of transfers."""
    return [tag for tag in tags if tag.write is not None and tag.name not in TARGETS]


def most_requests(tag: Tag) -> int:
    """Returns the most requests that write the tag: one for each element."""
    return (tag.layout.type.count or 1) * (2 if tag.write is not None and tag.write.repeat else 1)


def times(station: Troubled, tag: Tag, known: Sequence[int] = ()) -> int:
    """Returns how often the PLC has obeyed since `known`, at the address with the most."""
    now = counts(station, tag)
    return max(n - before for n, before in zip(now, known or [0] * len(now), strict=True))


def counts(station: Troubled, tag: Tag) -> list[int]:
    """Returns by address the times of writes to the tag: some PLCs write it byte by byte."""
    area, start, size = tag.span
    return [
        len({at for at, _ in station.written.get((area, n), ())})
        for n in range(start, start + size)
    ]


def all_times(station: Troubled, tag: Tag) -> set[float]:
    return {at for at, _ in station.written.get((tag.span.area, tag.span.start), ())}


def claimed(said: str, value: Value | None) -> Value | None:
    """Returns the elements that an unclear end says are in the PLC."""
    part = _part(said, CLAIM)
    return value[part] if part is not None and isinstance(value, tuple) else None


def _part(said: str, what: str) -> slice | None:
    """Returns the elements of which an end says this."""
    claim = re.search(rf"elements? (\d+)(?: to (\d+))?\){what}", said)
    return slice(int(claim[1]), int(claim[2] or claim[1]) + 1) if claim else None


def unsent_arrived(station: Troubled, tag: Tag, said: str, since: float) -> bool:
    """Elements were written of which the end says that they were not sent."""
    part = _part(said, " was not sent")
    if part is None:
        return False
    area, start, size = tag.span
    step = size // tag.layout.type.count
    places = range(start + part.start * step, start + part.stop * step)
    return any(at >= since for n in places for at, _ in station.written.get((area, n), ()))
