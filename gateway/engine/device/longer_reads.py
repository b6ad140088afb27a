"""Chooses longer spans to read for a block, so that its replies differ in shape."""

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence

from gateway.planning.bad_addresses import BadAddresses, within
from gateway.planning.planner import Block
from gateway.protocols.capabilities import UnnumberedReplies
from gateway.protocols.driver import Cost, Span

LONGEST_STEP = 16  # addresses by which a read may grow, to reach the next byte of bits
MOST_CHOICES = 3  # shapes of one block: an extra reply that is late by two requests is noticed
MOST_WARY = 8  # shapes of one block while the device answers twice
MOST_FAILED = 3  # reads in a row of the longer span without a reply
REFUSED_FOR = 3600.0  # seconds until a longer read that was refused is tried again
KNOWN_FOR = 600.0  # seconds for which a device that comes back has the addresses that it had

Choice = tuple[Span, Hashable]  # a span to read, and the shape of its reply


class LongerReads:
    """The spans that may be read for each block of one device."""

    __slots__ = (
        "_bad",
        "_hull",
        "_lacking",
        "_shapes",
        "alone",
        "by_span",
        "driver",
        "failed",
        "forget_at",
    )

    def __init__(
        self,
        driver: UnnumberedReplies,
        tags: Mapping[str, tuple[int, int]],
        bad: BadAddresses,
    ) -> None:
        """`tags`: the first and last address of the tags, by area."""
        self.driver = driver
        self._hull = tags
        self._bad = bad
        self.by_span: dict[Span, list[Choice]] = {}
        # By block: when a longer span was refused last, and all that were
        self._lacking: dict[Span, tuple[float, list[Span]]] = {}
        self._shapes: Counter[Hashable] = Counter()  # of the planned blocks
        # By block: longer reads without a reply, and the shortest of them
        self.failed: dict[Span, tuple[int, Span]] = {}
        self.alone: set[Span] = set()  # to be read without other addresses once
        self.forget_at = math.inf  # when `forget` must be called

    def take_over(self, old: "LongerReads") -> None:
        """Takes over what the same station has refused, or was silent about."""
        self._lacking, self.failed, self.forget_at = old._lacking, old.failed, old.forget_at

    def choices(self, span: Span) -> list[Choice]:
        """Returns the span itself, then longer ones whose replies have other shapes."""
        found = self.by_span.get(span)
        if found is None:
            found = self.by_span[span] = self._choose(span, MOST_WARY)
        return found

    def planned(self, blocks: Sequence[Block]) -> None:
        """Notes the blocks of a new plan."""
        self._shapes = Counter(self.driver.reply_shape(block.span) for block in blocks)

    def costs(self, block: Block) -> list[Cost]:
        """Returns the costs of the spans that are usually read for the block."""
        alone = block.listed or self._shapes[self.driver.reply_shape(block.span)] < 2
        choices = [] if alone else self._choose(block.span, MOST_CHOICES)
        return [cost for span, _ in choices if (cost := self.driver.cost(span))] or [block.cost]

    def refused(self, span: Span, longer: Span, now: float) -> None:
        """Notes that addresses beside the span do not exist. Those on its other side may."""
        _, lacking = self._lacking.get(span, (now, []))
        self._lacking[span] = now, [*lacking, longer]
        self.by_span.pop(span, None)
        self.forget_at = min(self.forget_at, now + REFUSED_FOR)

    def forget(self, now: float) -> None:
        """Forgets refusals that are an hour old: the device may have these addresses now."""
        for span, (refused, _) in list(self._lacking.items()):
            if now - refused >= REFUSED_FOR:
                del self._lacking[span]
                self.by_span.pop(span, None)
                self.failed.pop(span, None)
        self.forget_at = min((at for at, _ in self._lacking.values()), default=math.inf)
        self.forget_at += REFUSED_FOR

    def refused_alone(self, span: Span, read: float | None) -> None:
        """Notes that the span is refused too. If it was not read since, those beside it may exist.

        `read`: when the span was read last.
        """
        known = self._lacking.get(span)
        if known is not None and (read is None or read < known[0]):
            del self._lacking[span]
            self.by_span.pop(span, None)

    def unanswered(self, span: Span, longer: Span, now: float) -> None:
        """Counts a read of a longer span without a reply: some stations refuse by silence.

        The next read is that of the span itself. After `MOST_FAILED` the shortest one that failed
        is refused.
        """
        self.alone.add(span)
        count, shortest = self.failed.pop(span, (0, longer))
        if longer.size < shortest.size:
            shortest = longer
        if count + 1 < MOST_FAILED:
            self.failed[span] = count + 1, shortest
        else:
            self.refused(span, shortest, now)

    def answered(self, span: Span, longer: Span) -> None:
        """Notes a reply to a read of a longer span. It says nothing of one that is longer still."""
        known = self.failed.get(span)
        if known is not None and within(known[1], longer):
            del self.failed[span]

    def restart(self, now: float) -> None:
        """Starts again after the device came online: it may have other addresses now."""
        self.by_span.clear()
        self.alone.clear()
        for span, (refused, _) in list(self._lacking.items()):
            if now - refused >= KNOWN_FOR:
                del self._lacking[span]
                self.failed.pop(span, None)

    def _choose(self, span: Span, most: int) -> list[Choice]:
        """Returns the span, and longer ones whose replies have other shapes; `most` in all."""
        found: dict[Hashable, Span] = {self.driver.reply_shape(span): span}
        _, lacking = self._lacking.get(span, (0.0, []))
        for longer in self._longer(span):
            if any(within(refused, longer) for refused in lacking):
                continue
            found.setdefault(self.driver.reply_shape(longer), longer)
            if len(found) == most:
                break
        return [(read, shape) for shape, read in found.items()]

    def _longer(self, span: Span) -> Iterator[Span]:
        """Yields spans around `span` that one request reads, those among the tags first."""
        area, start, _ = span
        first, last = self._hull.get(area, (start, start))
        cuts = [place for name, place in self._bad.cuts if name == area]
        for among in (True, False):
            for longer in _around(span):
                end = longer.start + longer.size
                if among and not (first <= longer.start and end <= last + 1):
                    continue
                crosses = any(longer.start < place < end for place in cuts)
                if not crosses and self.driver.cost(longer) is not None:
                    yield longer


def _around(span: Span) -> Iterator[Span]:
    """Yields longer spans, first those that end later."""
    area, start, size = span
    for n in range(1, LONGEST_STEP + 1):
        yield Span(area, start, size + n)
    for n in range(1, min(LONGEST_STEP, start) + 1):
        yield Span(area, start - n, size + n)
