"""Finding the address a device refuses by halving its block, and remembering it.

A device answers a request that touches one address it does not have with a refusal of the
whole. The block is cut in two, and the refused half again, until the culprit stands alone;
then everything else is planned together again around it.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.planning.planner import Block, Cuts, items_of
from gateway.protocols.driver import Cost, Span
from gateway.tags import Tag

RETRY = 300.0  # seconds between two tries of an address that was refused
CostOf = Callable[[Span], Cost | None]


@dataclass(frozen=True, slots=True)
class BadRange:
    """Addresses the device refuses."""

    span: Span
    since: int  # ns since 1970
    code: str
    tags: tuple[Tag, ...]


class Learned(NamedTuple):
    """What is worth knowing after a restart."""

    refused: tuple[tuple[Span, int, str], ...]  # the addresses, since when, the maker's code
    cuts: tuple[tuple[str, int], ...]


@dataclass(slots=True)
class _Node:
    """A block under suspicion, or one half of one."""

    span: Span
    good: bool | None = None
    halves: tuple["_Node", ...] = ()

    def settled(self) -> bool:
        return all(half.settled() for half in self.halves) if self.halves else self.good is not None

    def cuts(self) -> set[tuple[str, int]]:
        """The boundaries that the finished search has shown to be needed."""
        if not self.halves:
            if self.good:
                return set()
            return _bounds(self.span)
        if all(half.good for half in self.halves):  # each is there, but not both in one request
            return {(self.span.area, self.halves[1].span.start)}
        return set().union(*(half.cuts() for half in self.halves))


def _within(inner: Span, outer: Span) -> bool:
    return inner.area == outer.area and (
        outer.start <= inner.start and inner.start + inner.size <= outer.start + outer.size
    )


def _bounds(span: Span) -> set[tuple[str, int]]:
    return {(span.area, span.start), (span.area, span.start + span.size)}


@dataclass(slots=True)
class Refusals:
    """What one device refuses. Feed it each refused and each good block."""

    cost: CostOf
    bad: dict[Span, BadRange] = field(default_factory=dict)
    _cuts: set[tuple[str, int]] = field(default_factory=set)
    _roots: list[_Node] = field(default_factory=list)
    _leaves: dict[Span, _Node] = field(default_factory=dict)

    @property
    def cuts(self) -> Cuts:
        """Boundaries the planner must keep."""
        return frozenset(self._cuts)

    @property
    def searching(self) -> bool:
        return bool(self._roots)

    def refused(self, block: Block, now: int, code: str) -> tuple[Block, ...]:
        """What to ask instead of `block`: its two halves, or nothing where it is the culprit."""
        node = self._leaves.pop(block.span, None)
        if block.span in self.bad:
            if node is not None:
                node.good = False
            return ()
        if node is None:
            node = _Node(block.span)
            self._roots.append(node)
        halves = self._halves(block, node)
        if not halves:
            node.good = False
            self.bad[block.span] = BadRange(block.span, now, code, block.tags)
        return halves

    def read(self, block: Block) -> bool:
        """The block was read well. True when an address refused before is there now."""
        node = self._leaves.pop(block.span, None)
        if node is not None:
            node.good = True
        if self.bad.pop(block.span, None) is None:
            return False
        self._cuts -= _bounds(block.span)
        for span in self.bad:  # a neighbour may share a boundary
            self._cuts |= _bounds(span)
        return True

    def settle(self) -> bool:
        """True when all searches have just ended: plan the device anew."""
        if not self._roots or not all(root.settled() for root in self._roots):
            return False
        for root in self._roots:
            self._cuts |= root.cuts()
        self.abandon()
        return True

    def abandon(self) -> None:
        """The blocks are about to be other ones: what is still searched for will be again."""
        self._roots.clear()
        self._leaves.clear()

    def learned(self) -> Learned:
        refused = tuple((bad.span, bad.since, bad.code) for bad in self.bad.values())
        return Learned(tuple(sorted(refused)), tuple(sorted(self._cuts)))

    def recall(self, learned: Learned, tags: Iterable[Tag]) -> None:
        """Begin with what an earlier run found, as far as there are still tags for it."""
        self._cuts |= set(learned.cuts)
        by_area = {span.area for span, _, _ in learned.refused}
        known = [tag for tag in tags if tag.span.area in by_area]
        for span, since, code in learned.refused:
            there = tuple(tag for tag in known if _within(tag.span, span))
            if [(i.start, i.end) for i in items_of(there)] == [
                (span.start, span.start + span.size)
            ]:
                self.bad[span] = BadRange(span, since, code, there)
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
