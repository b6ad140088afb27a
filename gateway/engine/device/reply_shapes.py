"""Alternates the shapes of a device's replies, so that an extra reply matches no request.

Replies without a number are told apart by shape: kind and length. If a station or a device server
repeats one reply, every later reply answers the request before its own. So requests in quick
succession to one device do not expect replies of one shape: where they would, one reads some
addresses more. An extra reply then arrives as a stray frame.
"""

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field

from gateway.engine.device.long_writes import LongWrite
from gateway.engine.device.longer_reads import MOST_CHOICES, LongerReads
from gateway.engine.device.twins import Twins
from gateway.planning.bad_addresses import BadAddresses
from gateway.planning.planner import Block
from gateway.protocols.capabilities import UnnumberedReplies
from gateway.protocols.driver import AnyDriver, Span
from gateway.tags import Tag

QUIET = 0.25  # seconds after a reply in which an extra reply would have arrived
WARY = 1.5  # the same after an extra reply: others may be as late
WARY_FOR = 600.0  # seconds
MARK_FIRST, MARK_LONGEST = 60.0, 600.0  # seconds between two resyncs on a wire that is never quiet
SHOWN = 60.0  # seconds for which an extra reply explains the state of the device
INSIDE = 64  # units of a read inside a block, at most
IN_VAIN = 8  # resyncs in a row that proved nothing
MOST_HELD = 8  # reads that one resync proves, at most
NEVER = float("inf")
UNPROVEN = "extra replies may arrive on this line, and nothing proves this read"


@dataclass(slots=True)
class GoodReads:
    """Blocks that the device has replied to: the last one, and the widest of its plan."""

    last: Span | None = None
    widest: Span | None = None
    replanned: bool = False  # the next good read begins again: no resync is under way then
    _sound: tuple[Sequence[Span], Sequence[Span]] = (), ()  # bad addresses, and what is not bad

    def take_over(self, old: "GoodReads") -> None:
        """Takes over the last block of the same station with another plan."""
        self.last = old.last

    def replan(self) -> None:
        """Notes another plan."""
        self.replanned = True

    def note(self, span: Span) -> None:
        self.last = span
        if self.widest is None or self.replanned or span.size > self.widest.size:
            self.widest, self.replanned = span, False

    def others(self, bad: BadAddresses, find: Callable[[], Sequence[Span]]) -> Sequence[Span]:
        """Returns what `find` returned for these bad addresses."""
        known, now = self._sound[0], (*bad.bad,)
        if known != now or not self._sound[1]:
            self._sound = now, find()
        return self._sound[1]

    @property
    def spans(self) -> Iterable[Span]:
        """The last block, then the widest, if it is wider."""
        last, widest = self.last, self.widest
        if last is None:
            return ()
        return (last, widest) if widest is not None and widest.size > last.size else (last,)


@dataclass(slots=True)
class ProofPace:
    """The reads of one device that a resync proves. Noise destroys the proof of many more often."""

    most: int = 1
    _in_vain: int = 0  # resyncs in a row that proved nothing
    lacked_until: float = -NEVER  # until then it has no read with a form of its own: refused

    # Until then it is silent about the reads that the second request of a resync may have.
    seconds_from: float = -NEVER
    twins: Twins = field(default_factory=Twins)

    def ended(self, *, proven: bool) -> None:
        """Notes the end of reads that waited for one resync."""
        self.most = min(2 * self.most, MOST_HELD) if proven else 1
        self._in_vain = 0 if proven else self._in_vain + 1

    @property
    def are_in_vain(self) -> bool:
        """True if none of the last reads had its proof: another try only takes the wire."""
        return self._in_vain >= IN_VAIN

    def lacks(self, now: float) -> None:
        """Notes that the device refused the read with a form of its own."""
        self.lacked_until = now + WARY_FOR

    def lacks_seconds(self, now: float) -> None:
        """Notes that the device was silent about second requests, although it is not late."""
        self.seconds_from = now + WARY_FOR


class ReplyShapes:
    """The last replies of one device. Times in seconds of the line's clock."""

    __slots__ = (
        "_acked",
        "_mark",
        "_recent",
        "_unclear_until",
        "_used",
        "at",
        "extra_at",
        "longer",
        "mark_due",
        "proofs",
        "proven",
        "quiet",
        "span",
        "wary_at",
    )

    def __init__(self, longer: LongerReads) -> None:
        self.longer = longer
        self._used: dict[Hashable, float] = {}  # when a read with each shape was sent last
        self._recent: deque[Hashable] = deque(maxlen=MOST_CHOICES - 1)  # of the last requests
        self.span: Span | None = None  # of the last read
        self.at = -NEVER  # when the last transaction ended
        self.quiet = QUIET
        self.proven = 0.0  # values read before are no extra replies
        self.mark_due = 0.0  # when a resync must show the order, if the wire is not quiet before
        self.extra_at = -NEVER  # when an extra reply arrived
        self.wary_at = -NEVER  # the same for any device of the line
        # Until then one more error reply may arrive, or the reply to a broadcast
        self._unclear_until = -NEVER
        self._acked: tuple[Hashable, float] = (None, -NEVER)  # the last acknowledgement, and when
        self.proofs = ProofPace()
        self._mark = MARK_FIRST

    def polled(self, block: Block, now: float) -> Span:
        """Returns the span to read for the block: its own, or a longer one around it."""
        span = block.span
        if block.listed:
            self.sent(block.cost.reply, now)
            return span
        choices = self.longer.by_span.get(span) or self.longer.choices(span)
        used = self._used
        shape, read = choices[0][1], span  # the caller tells the block's own span by identity
        if now - self.at >= self.quiet:
            self._prove(now)
        elif self.is_recent(shape, now):
            longest_ago = used.get(shape, -NEVER)
            some = choices if self.quiet == WARY else choices[:MOST_CHOICES]
            if span in self.longer.alone:
                self.longer.alone.discard(span)
            else:  # as min(some, key=...), which is slower
                for choice in some:
                    at = used.get(choice[1], -NEVER)
                    if at < longest_ago:
                        longest_ago, (read, shape) = at, choice
        used[shape] = now
        self._recent.append(shape)
        if self.quiet == WARY:
            self.proofs.twins.asked()
        self.span = read
        return read

    def collides(self, block: Block, now: float) -> bool:
        """Returns True if a longer span would be read for the block now."""
        if block.listed or now - self.at >= self.quiet:
            return False
        return self.is_recent(self.longer.choices(block.span)[0][1], now)

    def is_recent(self, shape: Hashable, now: float) -> bool:
        """Returns True if one of the last two requests has the shape, or one of the last 1.5 s
        while the device answers twice."""
        if now - self._used.get(shape, -NEVER) >= self.quiet:
            return False
        return self.quiet == WARY or shape in self._recent

    def sent(self, shape: Hashable, now: float) -> None:
        """Notes a read that is no poll, or a command, and the shape of its reply."""
        self._used[shape] = now
        self._sent(shape, now)

    def also_sent(self, shape: Hashable, now: float) -> None:
        """Notes a read that belongs to another request: a resync, or what a peek reads."""
        self._used[shape] = now

    def used_at(self, shape: Hashable) -> float:
        """Returns the time of the last request whose reply has the shape, but writes."""
        return self._used.get(shape, -NEVER)

    def of(self, span: Span) -> Hashable:
        """Returns the shape of the reply to a read of the span."""
        return self.longer.driver.reply_shape(span)

    def inside(self, spans: Sequence[Span], outstanding: Span | None) -> set[Hashable]:
        """Returns the shapes of reads inside the spans, but that of the outstanding one."""
        sizes = ((span, size) for span in spans for size in range(1, min(span.size, INSIDE) + 1))
        found = {self.of(Span(span.area, span.start, size)) for span, size in sizes}
        return found - {None, outstanding and self.of(outstanding)}

    def probed(
        self, outstanding: Span | None, token: int, spans: Sequence[Span], now: float
    ) -> None:
        """Notes a resync that is sent alone."""
        self.sent(self.of_resync(outstanding, token, spans), now)

    def of_resync(self, outstanding: Span | None, token: int, spans: Sequence[Span]) -> Hashable:
        """Returns the shape of the reply to a resync, as the driver."""
        return self.longer.driver.resync_shape(outstanding, token, spans)

    def _sent(self, shape: Hashable, now: float) -> None:
        self._recent.append(shape)
        if self.quiet == WARY:
            self.proofs.twins.asked()
        if now - self.at >= self.quiet:
            self._prove(now)

    def written(
        self, span: Span, units: Sequence[int], reads: bool, now: float
    ) -> tuple[bool, bool]:
        """Notes a write. Returns True where a resync must precede it, and follow it.

        It precedes where the write begins with a read whose reply may be an extra one. It follows
        where the acknowledgement may be an extra one. `reads`: the span is read before, because
        parts of its words are written.
        """
        replies = self.longer.driver.write_shapes(span, units)
        if reads:
            replies = (self.longer.driver.reply_shape(span), None)
        before, after = False, self.may_be_extra(replies[-1], now)
        for shape in replies[:-1]:
            before = self.is_wary or now - self._used.get(shape, -NEVER) < self.quiet
            self._used[shape] = now
        self._sent(replies[-1], now)
        return before, after

    def tells_apart(self, long: LongWrite, units: Sequence[int]) -> bool:
        """Returns True if no acknowledgement of these requests can be taken for another."""
        shapes, at = set[Hashable](), 0
        for span in long.spans:
            shapes.add(self.longer.driver.write_shapes(span, units[at : at + span.size])[-1])
            at += span.size
        return None not in shapes and len(shapes) == len(long.spans)

    def may_be_extra(self, shape: Hashable, now: float) -> bool:
        """Returns True if an earlier reply to a write, or a refusal, may arrive once more.

        `shape` of the expected reply; None: unknown.
        """
        if self.is_wary or now < self._unclear_until:
            return True
        acked, at = self._acked
        alike = shape == acked or shape is None or acked is None
        return alike and now - at < self.quiet

    def acknowledged(self, now: float) -> None:
        """Notes that the last request, a write or command, was acknowledged."""
        self._acked = (self.last, now)

    def refused(self, now: float) -> None:
        """Notes an error reply."""
        self.told_all(now + self.quiet)

    def told_all(self, until: float) -> None:
        """Notes a broadcast, to which the station may reply until then."""
        self._unclear_until = max(self._unclear_until, until)

    def marked(self, now: float) -> None:
        """Notes a resync: its reply shows that no extra reply is waiting."""
        self._mark = min(2 * self._mark, MARK_LONGEST)
        self._prove(now)

    def _prove(self, now: float) -> None:
        self.proven, self.mark_due = now, now + self._mark
        if now - self.wary_at >= WARY_FOR:
            self.quiet = QUIET
        if now >= self.longer.forget_at:
            self.longer.forget(now)

    def extra_arrived(self, now: float) -> None:
        """Notes an extra reply."""
        self.extra_at, self._mark = now, MARK_FIRST
        self.doubt(now)

    def doubt(self, now: float) -> None:
        """Notes an extra reply of any device of the line: from now on each read needs a proof."""
        self.wary_at, self.quiet = now, WARY

    @property
    def last(self) -> Hashable:
        """The shape of the reply to the last request."""
        return self._recent[-1] if self._recent else None

    @property
    def is_wary(self) -> bool:
        """True if an extra reply arrived on the line, and it was not clean for long since."""
        return self.quiet == WARY

    @property
    def answers_twice(self) -> bool:
        """True if an extra reply arrived recently."""
        return self.at - self.extra_at < SHOWN


def reply_shapes(driver: AnyDriver, tags: Sequence[Tag], bad: BadAddresses) -> ReplyShapes | None:
    """Returns the shapes of a device's replies; None where replies carry a number."""
    if not isinstance(driver, UnnumberedReplies) or not driver.unnumbered:
        return None
    hull: dict[str, tuple[int, int]] = {}
    for tag in tags:
        area, start, size = tag.span
        first, last = hull.get(area, (start, start))
        hull[area] = (min(first, start), max(last, start + size - 1))
    return ReplyShapes(LongerReads(driver, hull, bad))
