"""Finds the addresses a device refuses by halving their block, and remembers them.

A device refuses a whole request, or does not reply to it, when one of its addresses does not
exist. The block is halved, then the failed half, until the bad address stands alone. Then the
planner covers all other addresses again, with cuts around the bad ones.

If both halves are read although their block failed, the block may be too long for the device, or
noise hit it. So the block is tried once more as a whole. It is split if it fails again. After
growing pauses its splits are dropped again, one at a time.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from gateway.planning.planner import Block, Cuts, items_of
from gateway.protocols.driver import Cost, Span
from gateway.tags import Tag

# Seconds between two tries of a bad address: a short refusal costs little, a missing one as well.
RETRIES = (2.0, 10.0, 60.0, 300.0)
SPLIT_FIRST, SPLIT_LONGEST = 600.0, 86_400.0  # seconds until a split block is tried as a whole
SILENT = "no reply"  # the code of addresses about which the device is silent
DAMAGED = "no whole reply"  # the code of addresses whose replies arrive in part: of the wire
Cut = tuple[str, int]  # (area, n): a boundary between n - 1 and n
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
        """Seconds until it is tried again; not long after a damaged reply, for the device has the
        address."""
        last = 1 if self.code == DAMAGED else len(RETRIES) - 1
        return RETRIES[min(self.refusals, last)]

    @property
    def how(self) -> str:
        """The code, as part of a sentence."""
        return self.code if self.code in (SILENT, DAMAGED) else f"refused with {self.code}"

    @property
    def silent(self) -> bool:
        """True if the device does not reply at all: each try costs a time-out."""
        return self.code == SILENT


class KnownBad(NamedTuple):
    """Bad addresses and cuts, as the state file keeps them across a restart."""

    refused: tuple[tuple[Span, int, str], ...]  # span, since (ns since 1970), the maker's code
    cuts: tuple[Cut, ...]


@dataclass(slots=True)
class _Node:
    """A refused block, or one half of a refused block."""

    span: Span
    good: bool | None = None
    is_damaged: bool = False  # replies arrived in part: noise, not a missing address
    halves: tuple["_Node", ...] = ()

    def settled(self) -> bool:
        return all(half.settled() for half in self.halves) if self.halves else self.good is not None

    def splits(self) -> set[Cut]:
        """Returns the boundaries between two good halves of a failed block."""
        if not self.halves:
            return set()
        if all(half.good for half in self.halves):
            return {(self.span.area, self.halves[1].span.start)}
        return set().union(*(half.splits() for half in self.halves))

    def open(self) -> set[Span]:
        """Returns the failed blocks, of this one and its halves, whose search has not ended."""
        if not self.halves or self.is_damaged or self.settled():
            return set()
        return {self.span}.union(*(half.open() for half in self.halves))

    def failed_twice(self) -> set[Cut]:
        """Returns the boundaries between the halves of failed blocks, where a half failed too."""
        failed = (half for half in self.halves if half.halves or half.good is False)
        if self.is_damaged or not any(not half.is_damaged for half in failed):
            return set()
        inside = (half.failed_twice() for half in self.halves)
        return {(self.span.area, self.halves[1].span.start)}.union(*inside)


def within(inner: Span, outer: Span) -> bool:
    """Returns True if the outer span has all addresses of the inner one."""
    return inner.area == outer.area and (
        outer.start <= inner.start and inner.start + inner.size <= outer.start + outer.size
    )


def _is_inside(cut: Cut, blocks: Iterable[Span]) -> bool:
    area, n = cut
    return any(within(Span(area, n - 1, 2), span) for span in blocks)


def _bounds(span: Span) -> set[Cut]:
    return {(span.area, span.start), (span.area, span.start + span.size)}


@dataclass(slots=True)
class BadAddresses:
    """The bad addresses of one device. The caller reports each block that fails or is read.

    `bad` holds the ranges found so far. While `searching`, halves of failed blocks are still
    to be read. `splits` are boundaries inside blocks that can be read only in parts.
    """

    cost: CostOf
    bad: dict[Span, BadRange] = field(default_factory=dict)
    splits: set[Cut] = field(default_factory=set)
    searches: list[_Node] = field(default_factory=list)  # failed blocks, not yet settled
    changed: set[Span] = field(default_factory=set)  # to be planned again
    silenced: set[Span] = field(default_factory=set)  # one failure halves these, also for later
    clear: bool = True  # no address is bad, no block is split: a good read changes nothing
    _leaves: dict[Span, _Node] = field(default_factory=dict)
    _fell: set[Span] = field(default_factory=set)  # fell silent once, and not read since
    _suspected: set[Cut] = field(default_factory=set)  # splits unless the whole block is read
    _rejoin_at: float | None = None
    _rejoin_pause: float = SPLIT_FIRST
    _tried: Cut | None = None  # the split that was dropped last, of so many
    _tried_of: int = 0

    @property
    def cuts(self) -> Cuts:
        """Boundaries that no planned block may cross."""
        return frozenset(self.splits.union(*map(_bounds, self.bad)))

    @property
    def searching(self) -> bool:
        return bool(self.searches)

    def is_half(self, block: Block) -> bool:
        """Returns True while a search waits for this block."""
        return block.span in self._leaves

    def is_suspect(self, span: Span | None) -> bool:
        """Returns True for a block with an address about which the device may be silent."""
        return span in self.silenced or span in self.bad or span in self._leaves

    def has_failed(self, span: Span) -> bool:
        """Returns True for a block that no reply, or no good one, came to since it was read."""
        return self.is_suspect(span) or span in self._fell

    def is_trial(self, span: Span) -> bool:
        """Returns True for a whole block that had to be split before: one refusal is enough."""
        return any(_is_inside(cut, (span,)) for cut in self._suspected)

    def went_silent(self, block: Block) -> None:
        """Notes the request after which a device went offline that had just replied."""
        self.silenced.add(block.span)
        self.clear = False

    def fell_silent(self, block: Block) -> None:
        """Notes the block before a resync without a reply, after which the device went offline.

        Once this is noise, or the device. The second time, without a read of the block between,
        the device may be silent about an address of it.
        """
        (self.silenced if block.span in self._fell else self._fell).add(block.span)
        self.clear = False

    def refused(self, block: Block, now: int, code: str) -> tuple[Block, ...]:
        """Returns the two halves to read instead of `block`; empty when it is the bad address."""
        self.clear = False
        node = self._leaves.pop(block.span, None)
        if (known := self.bad.get(block.span)) is not None:
            self.bad[block.span] = replace(known, refusals=known.refusals + 1, code=code)
            if node is not None:
                node.good = False
            return ()
        if node is None:
            node = _Node(block.span)
            self.searches.append(node)
        node.is_damaged = code == DAMAGED
        halves = self._halves(block, node)
        if not halves:
            node.good = False
            self.bad[block.span] = BadRange(block.span, now, code, block.tags)
        elif block.span in self.silenced:  # the search may be dropped again
            self.splits.add((block.span.area, halves[1].span.start))
        return halves

    def replied(self, span: Span) -> None:
        """Notes values that were not taken, because they may be another reply: the address may have
        returned, so it is tried soon."""
        if (known := self.bad.get(span)) is not None:
            self.bad[span] = replace(known, refusals=0)

    def read(self, block: Block) -> bool:
        """Records a good read.

        Returns True when the block was bad before: then the device is to be planned again, and
        the other bad addresses are tried soon. They may have returned together.
        """
        node = self._leaves.pop(block.span, None)
        if node is not None:
            node.good = True
        self.silenced.discard(block.span)
        self._fell.discard(block.span)
        if self._suspected:  # the whole block is read: its halves were no cure
            area, start, size = block.span
            self._suspected -= {(area, n) for n in range(start + 1, start + size)}
        returned = self.bad.pop(block.span, None) is not None
        self._look()
        if not returned:
            return False
        self.changed.add(block.span)
        for span, other in self.bad.items():
            if other.refusals:
                self.bad[span] = replace(other, refusals=0)
        return True

    def settle(self, now: float) -> bool:
        """Ends the searches once all are complete. `now`: seconds, by the line's clock.

        Returns True then: the device is to be planned again.
        """
        if not self.searches or not all(root.settled() for root in self.searches):
            return False
        for root in self.searches:
            self.changed.add(root.span)
            self.silenced.discard(root.span)
            splits = root.splits()
            if proven := splits & self._suspected:
                self.splits |= proven
                self._rejoin_at = now + self._rejoin_pause
            self._suspected ^= splits
        self.abandon()
        return True

    def rejoin(self, now: float) -> bool:
        """Drops the next split after a pause: each that is still needed costs time-outs.

        An open search may end first, for one more pause: another plan would drop it, and on a slow
        line no search would ever end. If the whole block is read, the split after it follows at
        once. Returns True if the device is to be planned again.
        """
        if not self.splits:
            return False
        if self._rejoin_at is None:
            self._rejoin_at = now + self._rejoin_pause
        searching = self.searches or self._suspected
        fewer = not searching and len(self.splits) < self._tried_of
        is_open = any(not root.settled() for root in self.searches)
        wait = self._rejoin_pause if is_open else 0.0
        if now < self._rejoin_at + wait and not fewer:
            return False
        left = [cut for cut in self.splits if self._tried is None or cut > self._tried]
        if not left or self._tried is None:  # a round begins
            self._rejoin_pause = min(2 * self._rejoin_pause, SPLIT_LONGEST)
        self._tried_of, self._tried = len(self.splits), min(left or self.splits)
        area, n = self._tried
        self.changed.add(Span(area, n - 1, 2))
        self._suspected.add(self._tried)  # one search is enough to find it again
        self.splits.remove(self._tried)
        self._rejoin_at = None
        return True

    def abandon(self) -> None:
        """Drops the searches: the device gets other blocks, and a bad address is found again.

        The next search goes on where this one ends, or it would never end on a line that is often
        interrupted: in the halves that failed too, and in whole blocks after one failure."""
        self.splits |= self._open_splits()
        self.silenced |= self._open_spans()
        self.searches.clear()
        self._leaves.clear()
        self._look()

    def _look(self) -> None:
        kept = self.bad or self.searches or self.splits or self._suspected
        self.clear = not (kept or self.silenced or self._fell)

    def _open_splits(self) -> set[Cut]:
        open_ones = (root for root in self.searches if not root.settled())
        return set().union(*(root.failed_twice() for root in open_ones))

    def _open_spans(self) -> set[Span]:
        return set[Span]().union(*(root.open() for root in self.searches))

    def take_over(self, old: "BadAddresses", blocks: Collection[Span]) -> None:
        """Goes on with the searches of the same station, which has a new plan of these blocks."""
        self.silenced |= (old.silenced | old._open_spans()).intersection(blocks)
        self._fell |= old._fell.intersection(blocks)
        ended = (root.splits() for root in old.searches if root.settled())
        suspected = old._suspected.union(*ended)
        self._suspected |= {cut for cut in suspected if _is_inside(cut, blocks)}
        self._rejoin_at, self._rejoin_pause = old._rejoin_at, old._rejoin_pause
        self._tried, self._tried_of = old._tried, old._tried_of
        self._look()

    def known(self) -> KnownBad:
        refused = tuple((bad.span, bad.since, bad.code) for bad in self.bad.values())
        return KnownBad(tuple(sorted(refused)), tuple(sorted(self.cuts | self._open_splits())))

    def restore(self, known: KnownBad, tags: Iterable[Tag]) -> None:
        """Takes over the result of an earlier run. Skips ranges that the tags no longer fill."""
        self.splits = set(known.cuts).difference(*(_bounds(span) for span, _, _ in known.refused))
        areas = {span.area for span, _, _ in known.refused}
        candidates = [tag for tag in tags if tag.span.area in areas]
        for span, since, code in known.refused:
            inside = tuple(tag for tag in candidates if within(tag.span, span))
            if [(i.start, i.end) for i in items_of(inside)] == [
                (span.start, span.start + span.size)
            ]:
                self.bad[span] = BadRange(span, since, code, inside, refusals=len(RETRIES))
        self._look()

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
