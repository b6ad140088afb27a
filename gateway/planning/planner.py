"""Turns tags into blocks, the requests that read them at the least wire time.

Tags of one area share blocks. `coalesce` finds the blocks and their intervals exactly, from the
driver's character costs, the line's speed, the silence before a request and the station's
turnaround; no fixed gap is right at every baud rate. A slower tag joins a faster block where that
costs less than a request of its own.
"""

from bisect import bisect_left, bisect_right
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from gateway.errors import ConfigError
from gateway.planning.area_items import AreaItems, Seconds, requests_of
from gateway.planning.coalesce import Request
from gateway.protocols.driver import AnyDriver, Cost, Span
from gateway.protocols.models import Model, model_of
from gateway.tags import Tag
from gateway.tags.scan import Decoder

Cuts = frozenset[tuple[str, int]]  # (area, n): no block may hold both n - 1 and n
_NewBlock = tuple[Span, float, tuple[Tag, ...], Cost]  # the arguments of a `Block`


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One request and the tags it feeds.

    `listed`: the spans of the monitor list that reads the block, if there is one.
    """

    span: Span
    every: float
    tags: tuple[Tag, ...]
    cost: Cost
    listed: tuple[Span, ...] = ()
    decoder: Decoder = field(init=False, repr=False)
    of_fields: bool = field(
        init=False, repr=False
    )  # frames protocol: the units are values, not words
    text: str = field(init=False, repr=False, default="")  # once `describe` has made it

    def __post_init__(self) -> None:
        begins, place = {}, 0
        for span in self.listed:
            begins[span] = place
            place += span.size
        start = self.span.start
        begin = [begins.get(tag.span, tag.span.start - start) for tag in self.tags]
        object.__setattr__(self, "decoder", Decoder(self.tags, begin))
        object.__setattr__(self, "of_fields", self.tags[0].origin.shape is not None)


@dataclass(slots=True)
class Item:
    """Tags with equal or overlapping spans: a block reads all of them or none."""

    start: int
    end: int  # exclusive
    every: float  # the shortest interval of the tags
    tags: list[Tag]


def plan(
    tags: Iterable[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts = frozenset()
) -> tuple[Block, ...]:
    """Returns the blocks that read every readable tag of one device at the least wire time.

    `seconds` gives the duration of a transaction of a given cost on this line with this station.
    The blocks are in the order of areas and addresses; equal arguments give equal blocks. Raises
    `ConfigError` for a tag that does not fit one request.
    """
    return tuple(Block(*one) for one in _planned(tags, driver, seconds, cuts))


def requests_a_second(
    tags: Iterable[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts = frozenset()
) -> float:
    """Returns the requests a second of the plan, without its blocks."""
    return sum(1 / every for _, every, _, _ in _planned(tags, driver, seconds, cuts))


def _planned(
    tags: Iterable[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts
) -> Iterator[_NewBlock]:
    model = model_of(driver)
    for area, some in _by_area(tags, driver):
        items = items_of(some)
        yield from _blocks(area, items, _cover(model, area, items, seconds, cuts), driver)


def shortest_round(
    tags: Iterable[Tag], driver: AnyDriver, seconds: Seconds, cuts: Cuts = frozenset()
) -> float:
    """Returns the least seconds in which all readable tags can be read once."""
    model, total = model_of(driver), 0.0
    for area, some in _by_area(tags, driver):
        items = items_of(some)
        for item in items:
            item.every = 1.0
        for request in _cover(model, area, items, seconds, cuts):
            cost = driver.cost(_span(area, items, request))
            total += 0.0 if cost is None else seconds(cost)
    return total


def _by_area(tags: Iterable[Tag], driver: AnyDriver) -> list[tuple[str, list[Tag]]]:
    found: dict[str, list[Tag]] = defaultdict(list)
    for tag in tags:
        if tag.polled:
            found[tag.span.area].append(tag)
    return [(area, found[area]) for area in sorted(found) if driver.areas[area].readable]


def _cover(
    model: Model, area: str, items: Sequence[Item], seconds: Seconds, cuts: Cuts
) -> Sequence[Request]:
    """Returns the requests of least wire time for the items of one area. Raises `ConfigError`."""
    fences = sorted(n for name, n in cuts if name == area)
    splits = (i + 1 for i, (a, b) in enumerate(pairwise(items)) if _between(a.end, b.start, fences))
    starts, ends, every = zip(*((item.start, item.end, item.every) for item in items), strict=True)
    row = AreaItems(area, starts, ends, every, frozenset(splits if fences else ()))
    try:
        return requests_of(row, model, seconds)
    except ValueError as error:
        address = items[error.args[0]].tags[0].text
        raise ConfigError(f"{address} cannot be read in one request") from None


def _span(area: str, items: Sequence[Item], request: Request) -> Span:
    start = items[request.first].start
    return Span(area, start, items[request.last].end - start)


def _blocks(
    area: str, items: Sequence[Item], requests: Sequence[Request], driver: AnyDriver
) -> Iterator[_NewBlock]:
    """Yields the block of each request. A tag joins the fastest request over it: the freshest."""
    members: dict[Request, list[Tag]] = {request: [] for request in requests}
    waiting = deque(requests)
    over: list[Request] = []  # requests over the current item
    for number, item in enumerate(items):
        over = [request for request in over if request.last >= number]
        while waiting and waiting[0].first == number:
            over.append(waiting.popleft())
        members[min(over, key=lambda request: request.every)] += item.tags
    for request, tags in members.items():
        span = _span(area, items, request)
        cost = driver.cost(span)
        if cost is not None and tags:
            yield span, request.every, tuple(tags), cost


def _between(end: int, start: int, fences: Sequence[int]) -> bool:
    """Returns True when a cut lies between an item that ends at `end` and the next at `start`."""
    place = bisect_left(fences, end)
    return place < len(fences) and fences[place] <= start


def items_of(tags: Iterable[Tag]) -> list[Item]:
    """Sorts tags by address. Joins overlapping tags: bits of one word, two views of one value."""
    items: list[Item] = []
    for tag in sorted(tags, key=lambda tag: (tag.span.start, tag.span.size, tag.name)):
        end = tag.span.start + tag.span.size
        if items and tag.span.start < items[-1].end:
            items[-1].tags.append(tag)
            items[-1].end = max(items[-1].end, end)
            items[-1].every = min(items[-1].every, tag.every)
        else:
            items.append(Item(tag.span.start, end, tag.every, [tag]))
    return items


def around(blocks: Sequence[Block], span: Span) -> range:
    """Returns the places of the blocks that begin in the span, and of their neighbours.

    `blocks` are in the order of areas and addresses.
    """
    end = Span(span.area, span.start + span.size, 0)
    first = bisect_right(blocks, span, key=lambda block: block.span)
    last = bisect_left(blocks, end, key=lambda block: block.span)
    return range(max(0, min(first, last) - 2), min(len(blocks), last + 1))


def runs_of(tags: Iterable[Tag]) -> list[Span]:
    """Returns the spans of the tags; spans without a gap between them are one."""
    runs: list[Span] = []
    for area, start, size in sorted(tag.span for tag in tags):
        if runs and runs[-1].area == area and start <= runs[-1].start + runs[-1].size:
            end = max(start + size, runs[-1].start + runs[-1].size)
            runs[-1] = runs[-1]._replace(size=end - runs[-1].start)
        else:
            runs.append(Span(area, start, size))
    return runs


def describe(block: Block) -> str:
    """Returns the first and last address of a block as the file writes them: `D7.3..D10`."""
    if not block.text:  # kept: the status names every block every few seconds
        first = min(block.tags, key=lambda tag: tag.span)
        last = max(block.tags, key=lambda tag: (tag.span.area, tag.span.start + tag.span.size))
        text = first.text if first is last else f"{first.text}..{last.text}"
        object.__setattr__(block, "text", text)
    return block.text
