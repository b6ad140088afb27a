"""Checks of arrays: the settings that only a single value has, and what one request holds."""

from collections.abc import Sequence
from dataclasses import replace

from gateway.config.messages import Mistakes, Path
from gateway.planning.planner import items_of
from gateway.protocols.driver import Addressing, Cost, Span
from gateway.tags import Tag
from gateway.values import ValueType

_LONG = 4  # units; no single number has more


def most_that_fits(driver: Addressing, span: Span, kind: ValueType, *, write: bool) -> str:
    """Returns the longest array there that one request holds, for a message; empty: none."""
    size = span.size // kind.count
    cost_of = driver.write_cost if write else driver.cost
    for count in range(kind.count - 1, 0, -1):
        cost: Cost | None = cost_of(span._replace(size=count * size))
        if cost is not None:
            return f": at most {replace(kind, count=count)}"
    return ""


def check_overlaps(driver: Addressing, tags: Sequence[Tag], path: Path, mistakes: Mistakes) -> None:
    """Notes tags that overlap and that no request can read together: each is read as a whole."""
    areas = {tag.span.area for tag in tags if tag.span.size > _LONG and tag.origin.shape is None}
    for area in areas:
        if not driver.areas[area].readable:
            continue
        for item in items_of(tag for tag in tags if tag.span.area == area):
            size = item.end - item.start
            if len(item.tags) > 1 and driver.cost(Span(area, item.start, size)) is None:
                last = max(item.tags, key=lambda tag: tag.span.start + tag.span.size)
                mistakes.add(
                    (*path, last.name, "address"),
                    f"{item.tags[0].text} to {last.text} overlap, and together they are {size} "
                    "addresses, more than one request can carry: make them shorter",
                )
