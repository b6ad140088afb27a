"""Reads for a resync: short ones, of addresses that the device has by its configuration.

A device may be silent about addresses that it lacks. So a resync reads inside the spans that the
caller names, and each resync in another place and with another form of its reply.
"""

from collections.abc import Awaitable, Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from gateway.errors import Refused
from gateway.protocols.driver import EVERY_REQUEST, PROOF, Span

MOST_UNITS, MOST_FORMS = 64, 6  # of one read; of the reads in one place
PROOF_FORM = 9  # the form that resyncs do not use otherwise
MOST_EARLIER = 16  # resyncs before this one
ENDS_FOR = 8  # resyncs that read one end of a place, until they read the other one
# The form of the reply to a read, such as its number of bytes; None: it cannot be read.
FormOf = Callable[[Span], Hashable | None]


def told_from(
    read: Span, token: int, outstanding: Span | None, pick: Callable[[int], Span], form: FormOf
) -> int:
    """Returns the number of outstanding requests whose replies differ from that to `read`.

    `pick` returns the read of a token. These are the `outstanding` read and the resyncs before.
    """
    own = form(read)
    if outstanding is not None and form(outstanding) == own:
        return 0
    found = int(outstanding is not None)
    for earlier in range(token - 2, max(0, token - 2 * MOST_EARLIER), -2):
        if own in (form(pick(earlier)), form(pick(earlier + 1))):
            break
        found += 1
    return found


async def resync_by_reads(
    read: Callable[[Span], Awaitable[object]],
    token: int,
    outstanding: Span | None,
    pick: Callable[[int], Span],
    form: FormOf,
) -> int:
    """Sends the read of the token. Returns the number of requests that its reply is told from.

    An error reply names no request: it may be the late reply to the `outstanding` read. So one
    more read with another form follows it. Raises `Refused` where there is none.
    """
    if token == PROOF:
        await read(pick(PROOF))
        return EVERY_REQUEST
    sent, other = pick(token), pick(token + 1)
    try:
        await read(sent)
    except Refused:
        if form(sent) == form(other):
            raise
        await read(other)
        sent = other
    return told_from(sent, token, outstanding, pick, form)


@dataclass(slots=True)
class HarmlessReads:
    """The reads inside `spans` with another form than the `outstanding` read."""

    spans: Sequence[Span]
    outstanding: Span | None
    form: FormOf
    numbered: bool = False  # a reply names its request: its form may be that of the outstanding one
    _places: list[tuple[Sequence[Span], Sequence[Span]]] = field(init=False)

    def __post_init__(self) -> None:
        outstanding = self.outstanding
        late = None if outstanding is None or self.numbered else self.form(outstanding)
        places = (_place(self.form, span, late, outstanding) for span in self.spans)
        self._places = [place for place in places if place[0]]

    def __bool__(self) -> bool:
        return bool(self._places)

    @property
    def are_beside(self) -> bool:
        """True if one of them leaves out the outstanding read."""
        return any(beside(reads, self.outstanding) for place in self._places for reads in place)

    def pick(self, token: int) -> Span:
        """Returns the read of a token, which grows by two from one resync to the next.

        Every second one is in the first span. The reads begin where their span begins, or end
        where it ends: a bad address must not hide the device for long.
        """
        (first, *others), (step, second) = self._places, divmod(token, 2)
        end = step
        if others:
            end += step // ENDS_FOR  # not in pairs: both places may be the same block
            if step % 2:
                first = others[step // 2 % len(others)]
        reads = first[end % 2]
        return reads[(2 * step + second) % len(reads)]

    def proof(self, used: tuple[Hashable, ...] = ()) -> Span | None:
        """Returns a read whose form no other resync has, nor those `used`; None: there is none."""
        return _proof(self.form, tuple(self.spans), self.outstanding, used)


# Each time-out of a device asks for the same reads again.
@lru_cache(4096)
def _place(
    form: FormOf, span: Span, late: Hashable, outstanding: Span | None = None
) -> tuple[Sequence[Span], Sequence[Span]]:
    """Returns the reads at the begin of the span, and those at its end.

    The device may be silent about an address of the `outstanding` read: they leave it out, if a
    form is left without it.
    """
    area, start, size = span
    begin: dict[Hashable, Span] = {}
    end: dict[Hashable, Span] = {}
    for units in range(1, min(size, MOST_UNITS) + 1):
        for found, at in ((begin, start), (end, start + size - units)):
            read = Span(area, at, units)
            shape = form(read)
            if shape is not None and shape != late:
                found.setdefault(shape, read)
        if len(begin) == MOST_FORMS:
            break
    ends = list(begin.values()), list((end or begin).values())
    enough = [left for reads in ends if (left := beside(reads, outstanding))]
    return (enough[0], enough[-1]) if enough else ends


def beside(spans: Iterable[Span], outstanding: Span | None) -> list[Span]:
    """Returns those of the spans that have no address of the `outstanding` read."""
    return [span for span in spans if outstanding is None or not span.overlaps(outstanding)]


@lru_cache(1024)
def _proof(
    form: FormOf, spans: tuple[Span, ...], outstanding: Span | None, used: tuple[Hashable, ...]
) -> Span | None:
    late = None if outstanding is None else form(outstanding)
    forms = {form(read) for span in spans for reads in _place(form, span, late) for read in reads}
    forms.update(used, () if outstanding is None else (late,))
    for area, start, size in spans:
        found: set[Hashable] = set()
        for units in range(1, min(size, MOST_UNITS) + 1):
            read = Span(area, start, units)
            found.add(own := form(read))
            if len(found) >= PROOF_FORM and own is not None and own not in forms:
                return read
    return None


_ODD_SIZES = (1, 3, 5, 7, 9, 11, 13, 15)  # bytes: no read of words has these
_PROOF_SIZE = 17


def odd_reads(
    area: str, outstanding: Span | None, spans: Sequence[Span], form: FormOf
) -> Callable[[int], Span]:
    """Returns the read of each probe token, for replies that differ by their number of bytes.

    Every second one is inside the `spans`, if they allow it, the others read bits of the `area`
    from 0 on: a device may lack these, and be silent about them. The second read of a resync is in
    the other place.
    """
    late = None if outstanding is None else form(outstanding)
    sizes = [size for size in _ODD_SIZES if size != late]
    inside = HarmlessReads(spans, outstanding, form)

    def pick(token: int) -> Span:
        if token == PROOF:
            return inside.proof(_ODD_SIZES) or Span(area, 0, 8 * _PROOF_SIZE)
        step, second = divmod(token, 2)
        turn = step // 2 * 2 + second if inside else token
        if inside and step % 2 != second:
            return inside.pick(turn)
        return Span(area, 0, 8 * sizes[turn % len(sizes)])

    return pick
