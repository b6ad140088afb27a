"""Finds the addresses a device refuses by halving their block, and remembers them.

A device refuses a whole request when one of its addresses does not exist. The block is halved,
then the refused half, until the bad address stands alone. Then the planner covers all other
addresses again, with cuts around the bad ones.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from gateway.planning.planner import Block, Cuts, items_of
from gateway.protocols.driver import Cost, Span
from gateway.tags import Tag

# Seconds between two tries of a bad address: a short refusal costs little, a missing one as well.
RETRIES = (2.0, 10.0, 60.0, 300.0)
CostOf = Callable[[Span], Cost | None]


@dataclass(frozen=True, slots=True)
class BadRange:
    """Addresses the device refuses."""

    span: Span
    since: int  # ns since 1970
    code: str
    tags: tuple[Tag, ...]
    refusals: int = 0  # since it was found

    @property
    def retry(self) -> float:
        """Seconds until it is tried again."""
        return RETRIES[min(self.refusals, len(RETRIES) - 1)]


class KnownBad(NamedTuple):
    """Bad addresses and cuts, as the state file keeps them across a restart."""

    refused: tuple[tuple[Span, int, str], ...]  # span, since (ns since 1970), the maker's code
    cuts: tuple[tuple[str, int], ...]


@dataclass(slots=True)
class _Node:
    """A refused block, or one half of a refused block."""

    span: Span
    good: bool | None = None
    halves: tuple["_Node", ...] = ()

    def settled(self) -> bool:
        return all(half.settled() for half in self.halves) if self.halves else self.good is not None

    def cuts(self) -> set[tuple[str, int]]:
        """The boundaries that the completed search requires."""
        if not self.halves:
            if self.good:
                return set()
            return _bounds(self.span)
        if all(half.good for half in self.halves):  # the device refuses only both in one request
            return {(self.span.area, self.halves[1].span.start)}
        return set().union(*(half.cuts() for half in self.halves))


def _within(inner: Span, outer: Span) -> bool:
    return inner.area == outer.area and (
        outer.start <= inner.start and inner.start + inner.size <= outer.start + outer.size
    )


def _bounds(span: Span) -> set[tuple[str, int]]:
    return {(span.area, span.start), (span.area, span.start + span.size)}


@dataclass(slots=True)
class BadAddresses:
    """The bad addresses of one device. The caller reports each block the device refuses or reads.

    `bad` holds the ranges found so far. While `searching`, halves of refused blocks are still
    to be read.
    """

    cost: CostOf
    bad: dict[Span, BadRange] = field(default_factory=dict)
    _cuts: set[tuple[str, int]] = field(default_factory=set)
    searches: list[_Node] = field(default_factory=list)  # refused blocks, not yet settled
    _leaves: dict[Span, _Node] = field(default_factory=dict)

    @property
    def cuts(self) -> Cuts:
        """Boundaries that no planned block may cross."""
        return frozenset(self._cuts)

    @property
    def searching(self) -> bool:
        return bool(self.searches)

    def refused(self, block: Block, now: int, code: str) -> tuple[Block, ...]:
        """Returns the two halves to read instead of `block`; empty when it is the bad address."""
        node = self._leaves.pop(block.span, None)
        if (known := self.bad.get(block.span)) is not None:
            self.bad[block.span] = replace(known, refusals=known.refusals + 1)
            if node is not None:
                node.good = False
            return ()
        if node is None:
            node = _Node(block.span)
            self.searches.append(node)
        halves = self._halves(block, node)
        if not halves:
            node.good = False
            self.bad[block.span] = BadRange(block.span, now, code, block.tags)
        return halves

    def read(self, block: Block) -> bool:
        """Records a good read.

        Returns True when the block was bad before: then the device is to be planned again, and
        the other bad addresses are tried soon. They may have returned together.
        """
        node = self._leaves.pop(block.span, None)
        if node is not None:
            node.good = True
        if self.bad.pop(block.span, None) is None:
            return False
        self._cuts -= _bounds(block.span)
        for span, other in self.bad.items():  # a neighbour may share a boundary
            self._cuts |= _bounds(span)
            self.bad[span] = replace(other, refusals=0)
        return True

    def settle(self) -> bool:
        """Adopts the cuts once all searches are complete.

        Returns True then: the device is to be planned again.
        """
        if not self.searches or not all(root.settled() for root in self.searches):
            return False
        for root in self.searches:
            self._cuts |= root.cuts()
        self.abandon()
        return True

    def abandon(self) -> None:
        """Drops the searches: the device gets other blocks, and a bad address is found again."""
        self.searches.clear()
        self._leaves.clear()

    def known(self) -> KnownBad:
        refused = tuple((bad.span, bad.since, bad.code) for bad in self.bad.values())
        return KnownBad(tuple(sorted(refused)), tuple(sorted(self._cuts)))

    def restore(self, known: KnownBad, tags: Iterable[Tag]) -> None:
        """Takes over the result of an earlier run. Skips ranges that the tags no longer fill."""
        self._cuts |= set(known.cuts)
        areas = {span.area for span, _, _ in known.refused}
        candidates = [tag for tag in tags if tag.span.area in areas]
        for span, since, code in known.refused:
            inside = tuple(tag for tag in candidates if _within(tag.span, span))
            if [(i.start, i.end) for i in items_of(inside)] == [
                (span.start, span.start + span.size)
            ]:
                self.bad[span] = BadRange(span, since, code, inside, refusals=len(RETRIES))
                self._cuts |= _bounds(span)

    def _halves(self, block: Block, node: _Node) -> tuple[Block, ...]:
        items = items_of(block.tags)
        if len(items) < 2:
            return ()
        middle = len(items) // 2
        found = []
        for part in (items[:middle], items[middle:]):
            span = Span(block.span.area, part[0].start, part[-1].end - part[0].start)
            cost = self.cost(span)
            if cost is None:
                return ()
            tags = tuple(tag for item in part for tag in item.tags)
            found.append((Block(span, block.every, tags, cost), _Node(span)))
        node.halves = tuple(leaf for _, leaf in found)
        for half, leaf in found:
            self._leaves[half.span] = leaf
        return tuple(half for half, _ in found)
