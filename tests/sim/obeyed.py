"""Counts how often a PLC has carried out the writes of a tag."""

from collections.abc import Sequence

from gateway.tags import Tag
from tests.sim.stations import Troubled


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
