"""Alternates the shapes of a device's replies, so that an extra reply matches no request.

Replies without a number are told apart by shape: kind and length. If a station or a device server
repeats one reply, every later reply answers the request before its own. So requests in quick
succession to one device do not expect replies of one shape: where they would, one reads some
addresses more. An extra reply then arrives as a stray frame.
"""

from collections import Counter
from collections.abc import Hashable, Iterator, Mapping, Sequence

from gateway.planning.planner import Block
from gateway.protocols.driver import AnyDriver, Cost, Span, UnnumberedReplies
from gateway.tags import Tag

QUIET = 0.25  # seconds after a reply in which an extra reply would have arrived
LATE = 1.0  # the same, for a device that is known to answer twice
MARK_FIRST, MARK_LONGEST = 60.0, 600.0  # seconds between two resyncs on a wire that is never quiet
SHOWN = 60.0  # seconds for which an extra reply explains the state of the device
LONGEST_STEP = 16  # addresses by which a read may grow, to reach the next byte of bits
MOST_CHOICES = 3  # shapes of one block: an extra reply that is late by two requests is noticed
MOST_FAILED = 3  # reads in a row of the longer span without a reply
NEVER = float("inf")


Choice = tuple[Span, Hashable]  # a span to read, and the shape of its reply


class ReplyShapes:
    """The last replies of one device. Times in seconds of the line's clock."""

    __slots__ = (
        "_acked",
        "_choices",
        "_driver",
        "_hull",
        "_lacking",
        "_mark",
        "_refused",
        "_shapes",
        "_used",
        "at",
        "extra_at",
        "failed",
        "last",
        "mark_due",
        "proven",
        "span",
    )

    def __init__(self, driver: UnnumberedReplies, tags: Mapping[str, tuple[int, int]]) -> None:
        """`tags`: the first and last address of the tags, by area."""
        self.last: Hashable = None  # shape of the reply to the last request
        self._used: dict[Hashable, float] = {}  # when a reply of each shape was expected last
        self.span: Span | None = None  # of the last read
        self.at = -NEVER  # when the last transaction ended
        self.proven = 0.0  # values read before are no extra replies
        self.mark_due = 0.0  # when a resync must show the order, if the wire is not quiet before
        self.extra_at = -NEVER  # when an extra reply arrived
        self._refused = -NEVER  # when the last error reply arrived
        self._acked: tuple[Hashable, float] = (None, -NEVER)  # the last acknowledgement, and when
        self._mark = MARK_FIRST
        self._driver = driver
        self._hull = tags
        self._choices: dict[Span, list[Choice]] = {}
        self._lacking: dict[Span, list[Span]] = {}  # by block: longer spans that were refused
        self._shapes: Counter[Hashable] = Counter()  # of the planned blocks
        self.failed: dict[Span, int] = {}  # reads of longer spans in a row without a reply

    def polled(self, block: Block, now: float) -> Span:
        """Returns the span to read for the block: its own, or a longer one around it."""
        span = block.span
        if block.listed:
            self.sent(block.cost.reply, now)
            return span
        choices = self._choices.get(span)
        if choices is None:
            choices = self._choices[span] = self._choose(span)
        used = self._used
        shape, read = choices[0][1], span  # the caller tells the block's own span by identity
        if now - self.at >= QUIET:
            self._prove(now)
        elif now - used.get(shape, -NEVER) < QUIET:
            best = min(choices, key=lambda choice: used.get(choice[1], -NEVER))
            if best is not choices[0]:
                read, shape = best
        used[shape] = now
        self.last, self.span = shape, read
        return read

    def sent(self, shape: Hashable, now: float) -> None:
        """Notes a request that is no poll, and the shape of its last reply."""
        if now - self.at >= QUIET:
            self._prove(now)
        self.last = shape
        self._used[shape] = now

    def written(self, tag: Tag, units: Sequence[int], now: float) -> tuple[bool, bool]:
        """Notes a write. Returns True where a resync must precede it, and follow it.

        It precedes where the write begins with a read whose reply may be an extra one. It follows
        where the acknowledgement may be an extra one.
        """
        replies = self._driver.write_shapes(tag.span, units)
        if tag.address.bit is not None:  # the word is read first
            replies = (self._driver.reply_shape(tag.span), None)
        used = self._used.get(replies[0], -NEVER)
        before, after = now - used < QUIET, self.may_be_extra(replies[-1], now)
        self.sent(replies[-1], now)
        return before and len(replies) > 1, after

    def may_be_extra(self, shape: Hashable, now: float) -> bool:
        """Returns True if an earlier reply to a write, or a refusal, may arrive once more.

        `shape` of the expected reply; None: unknown. A device that answers twice may do so late.
        """
        acked, at = self._acked
        alike = shape == acked or shape is None or acked is None
        within = LATE if self.answers_twice else QUIET
        return (alike and now - at < within) or now - self._refused < within

    def acknowledged(self, now: float) -> None:
        """Notes that the last request, a write or command, was acknowledged."""
        self._acked = (self.last, now)

    def refused(self, now: float) -> None:
        """Notes an error reply."""
        self._refused = now

    def marked(self, now: float) -> None:
        """Notes a resync: its reply shows that no extra reply is waiting."""
        self._mark = min(2 * self._mark, MARK_LONGEST)
        self._prove(now)

    def _prove(self, now: float) -> None:
        self.proven, self.mark_due = now, now + self._mark

    def extra_arrived(self, now: float) -> None:
        """Notes an extra reply."""
        self.extra_at = now
        self._mark = MARK_FIRST

    @property
    def answers_twice(self) -> bool:
        """True if an extra reply arrived recently."""
        return self.at - self.extra_at < SHOWN

    # Forecast

    def planned(self, blocks: Sequence[Block]) -> None:
        """Notes the blocks of a new plan."""
        self._shapes = Counter(self._driver.reply_shape(block.span) for block in blocks)

    def costs(self, block: Block) -> list[Cost]:
        """Returns the costs of the spans that are read for the block."""
        alone = block.listed or self._shapes[self._driver.reply_shape(block.span)] < 2
        spans = [] if alone else [span for span, _ in self._choose(block.span)]
        return [cost for span in spans if (cost := self._driver.cost(span))] or [block.cost]

    # The longer span

    def refused_longer(self, span: Span, longer: Span) -> None:
        """Notes that addresses beside the span do not exist. Those on its other side may."""
        self._lacking.setdefault(span, []).append(longer)
        self._choices.pop(span, None)

    def refused_alone(self, span: Span) -> None:
        """Notes that the span is refused too: so the addresses beside it may exist."""
        if self._lacking.pop(span, None) is not None:
            self._choices.pop(span, None)

    def read_longer(self, span: Span, longer: Span, *, replied: bool) -> None:
        """Counts reads of the longer span without a reply. Some stations refuse by silence."""
        failed = self.failed.pop(span, 0) + 1
        if not replied:
            self.failed[span] = failed
            if failed >= MOST_FAILED:
                self.refused_longer(span, longer)
                del self.failed[span]

    def restart(self) -> None:
        """Starts again after the device came online: it may have other addresses now."""
        self._choices.clear()
        self._lacking.clear()
        self.failed.clear()

    def _choose(self, span: Span) -> list[Choice]:
        """Returns the span, and longer ones whose replies have other shapes."""
        found: dict[Hashable, Span] = {self._driver.reply_shape(span): span}
        lacking = self._lacking.get(span, ())
        for longer in self._longer(span):
            if any(_inside(refused, longer) for refused in lacking):
                continue
            found.setdefault(self._driver.reply_shape(longer), longer)
            if len(found) == MOST_CHOICES:
                break
        return [(read, shape) for shape, read in found.items()]

    def _longer(self, span: Span) -> Iterator[Span]:
        """Yields spans around `span` that one request reads, those among the tags first."""
        area, start, size = span
        first, last = self._hull.get(area, (start, start))
        steps = range(1, LONGEST_STEP + 1)
        both = [Span(area, start, size + n) for n in steps]
        both += [Span(area, start - n, size + n) for n in steps if start >= n]
        among = [s for s in both if first <= s.start and s.start + s.size - 1 <= last]
        for longer in [*among, *both]:
            if self._driver.cost(longer) is not None:
                yield longer


def _inside(inner: Span, outer: Span) -> bool:
    """Returns True if the outer span has all addresses of the inner one."""
    end = inner.start + inner.size
    return outer.start <= inner.start and end <= outer.start + outer.size


def reply_shapes(driver: AnyDriver, tags: list[Tag]) -> ReplyShapes | None:
    """Returns the shapes of a device's replies; None where replies carry a number."""
    if not isinstance(driver, UnnumberedReplies) or not driver.unnumbered:
        return None
    hull: dict[str, tuple[int, int]] = {}
    for tag in tags:
        area, start, size = tag.span
        first, last = hull.get(area, (start, start))
        hull[area] = (min(first, start), max(last, start + size - 1))
    return ReplyShapes(driver, hull)
