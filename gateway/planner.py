"""Tags -> blocks: what to ask a device so that the wire is busy the shortest time.

Tags of one area that are polled equally often share blocks. Where to cut is found exactly, by
dynamic programming over the driver's own character costs, the line's speed, the silence
before a request and the station's turnaround; no fixed gap is right at every baud rate. A
slower tag that lies inside a faster block rides along for nothing.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from gateway.errors import ConfigError
from gateway.protocols.driver import AnyDriver, Cost, Span
from gateway.tags import Quality, Reason, Sample, Tag, bad
from gateway.values import Value

Seconds = Callable[[Cost], float]
Decode = Callable[[Sequence[int]], Value | None]
Cuts = frozenset[tuple[str, int]]  # (area, n): no block may hold both n - 1 and n


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One request and the tags it feeds."""

    span: Span
    every: float
    tags: tuple[Tag, ...]
    cost: Cost
    parts: tuple[tuple[Decode, slice], ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        start = self.span.start
        parts = tuple(
            (tag.decode, slice(tag.span.start - start, tag.span.start - start + tag.span.size))
            for tag in self.tags
        )
        object.__setattr__(self, "parts", parts)

    def decode(self, units: Sequence[int], time: int) -> list[Sample]:
        """The samples of all tags; `time` is when the reply arrived (ns since 1970)."""
        good, new = Quality.GOOD, tuple.__new__  # half of what the constructor takes: it is much
        values = [decode(units[part]) for decode, part in self.parts]
        return [
            bad(tag, Reason.NOT_A_NUMBER, time)
            if value is None
            else new(Sample, (tag, value, good, time, None, ""))
            for tag, value in zip(self.tags, values, strict=True)
        ]


@dataclass(slots=True)
class Item:
    """Tags that any block takes all or none of: equal or overlapping spans."""

    start: int
    end: int  # exclusive
    tags: list[Tag]


def plan(
    tags: Iterable[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts = frozenset()
) -> tuple[Block, ...]:
    """Cover every readable tag of one device at the least wire time.

    `seconds` says how long an exchange of a given cost takes on this line with this station.
    The result is in the order of areas and addresses and depends on nothing but the arguments.
    """
    areas: dict[str, list[Tag]] = defaultdict(list)
    for tag in tags:
        if driver.areas[tag.span.area].readable:
            areas[tag.span.area].append(tag)
    blocks: list[Block] = []
    for area in sorted(areas):
        blocks += _plan_area(area, areas[area], driver, seconds, cuts)
    return tuple(blocks)


def _plan_area(
    area: str, tags: list[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts
) -> list[Block]:
    """Fastest interval first, so that slower tags find the blocks they can ride in."""
    rates: dict[float, list[Tag]] = defaultdict(list)
    for tag in tags:
        rates[tag.every].append(tag)
    spans: list[tuple[Span, float, Cost]] = []
    riders: list[list[Tag]] = []
    for every in sorted(rates):
        left = []
        for tag in rates[every]:
            host = _host(tag, spans)
            if host is None:
                left.append(tag)
            else:
                riders[host].append(tag)
        for span, cost, members in _cover(area, left, driver, seconds, cuts):
            spans.append((span, every, cost))
            riders.append(members)
    found = [
        Block(span, every, tuple(members), cost)
        for (span, every, cost), members in zip(spans, riders, strict=True)
    ]
    return sorted(found, key=lambda block: (block.span.start, block.every))


def _host(tag: Tag, spans: Sequence[tuple[Span, float, Cost]]) -> int | None:
    end = tag.span.start + tag.span.size
    for number, (span, _, _) in enumerate(spans):
        if span.start <= tag.span.start and end <= span.start + span.size:
            return number
    return None


def _cover(
    area: str, tags: list[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts
) -> list[tuple[Span, Cost, list[Tag]]]:
    """The cheapest set of spans that holds all tags of one interval.

    best[j] is the least time for the first j items; the last block of such a cover begins at
    some item i, so best[j] = min over i of best[i] + time(i..j). Driver costs never fall when
    a span grows, so the search for i ends where the span has become too long for one request.
    """
    items = items_of(tags)
    fences = sorted(n for name, n in cuts if name == area)
    fenced = [True] + [_between(a.end, b.start, fences) for a, b in pairwise(items)]
    best = [0.0]
    last: list[tuple[int, Cost]] = []  # of the cover of the first j items: its last block
    for j in range(1, len(items) + 1):
        end = items[j - 1].end
        least, choice = float("inf"), None
        for i in range(j - 1, -1, -1):
            start = items[i].start
            cost = driver.cost(Span(area, start, end - start))
            if cost is None:
                break
            time = best[i] + seconds(cost)
            if time < least - 1e-12:
                least, choice = time, (i, cost)
            if fenced[i]:
                break
        if choice is None:
            raise ConfigError(f"{items[j - 1].tags[0].text} cannot be read in one request")
        best.append(least)
        last.append(choice)
    return _walk_back(area, items, last)


def _between(end: int, start: int, fences: Sequence[int]) -> bool:
    """Whether a cut lies between an item that ends at `end` and the next one at `start`."""
    place = bisect_left(fences, end)
    return place < len(fences) and fences[place] <= start


def _walk_back(
    area: str, items: Sequence[Item], last: Sequence[tuple[int, Cost]]
) -> list[tuple[Span, Cost, list[Tag]]]:
    found = []
    j = len(items)
    while j:
        i, cost = last[j - 1]
        start, end = items[i].start, items[j - 1].end
        members = [tag for item in items[i:j] for tag in item.tags]
        found.append((Span(area, start, end - start), cost, members))
        j = i
    return found[::-1]


def items_of(tags: Iterable[Tag]) -> list[Item]:
    """Tags by address; those that overlap (bits of one word, two views of one value) as one."""
    items: list[Item] = []
    for tag in sorted(tags, key=lambda tag: (tag.span.start, tag.span.size, tag.name)):
        end = tag.span.start + tag.span.size
        if items and tag.span.start < items[-1].end:
            items[-1].tags.append(tag)
            items[-1].end = max(items[-1].end, end)
        else:
            items.append(Item(tag.span.start, end, [tag]))
    return items
