"""Writes that need several requests, and the sentence that accounts for every address of them."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

from gateway.errors import GatewayError, Refused, Unclear
from gateway.protocols.capabilities import WritesAround
from gateway.protocols.driver import Address, AnyDriver, Span

_TRIED = 8  # lengths of a request, until one needs no addresses around it: bits are in eights


@dataclass(slots=True)
class LongWrite:
    """The requests of one write, and how far they came."""

    driver: AnyDriver
    spans: Sequence[Span]  # of the requests, in their order
    elements: int  # of the value; 0: it is no list
    asked: int = 0  # requests sent
    done: int = 0  # of these, acknowledged
    # The resync after each request: it shows that the acknowledgement was not an earlier one that
    # arrived twice. Empty: no acknowledgement can be mistaken for another.
    tokens: Sequence[int] = ()

    def resync_each(self, tokens: Sequence[int]) -> None:
        """Has a resync sent after each request."""
        self.tokens = tokens

    def sends(self, number: int) -> None:
        """Notes that this request is sent."""
        self.asked = max(self.asked, number + 1)

    def not_sent(self, number: int) -> None:
        """Notes that this request was not sent, although it should be."""
        self.asked = max(self.done, number)

    def acknowledged(self, number: int) -> None:
        """Notes the acknowledgement of this request."""
        self.done = max(self.done, number + 1)

    def doubt(self) -> None:
        """Notes that the order of the replies is unknown: nothing is certain to be done."""
        self.done = 0

    def ended(self, error: GatewayError) -> GatewayError:
        """Returns the error with all addresses: in the PLC, unknown, not sent."""
        if not self.asked or self.done == len(self.spans):
            return error
        refused, parts = isinstance(error, Refused), []
        if self.done:
            parts.append(f"{self._part(0, self.done)} is in the PLC")
        if self.done < self.asked:
            how = "was refused" if refused else "is unknown"
            parts.append(f"{self._part(self.done, self.asked)} {how}")
        if self.asked < len(self.spans):
            parts.append(f"{self._part(self.asked, len(self.spans))} was not sent")
        text = f"{', '.join(parts)}: {error}"
        if isinstance(error, Refused) and not self.done:
            return Refused(text, code=error.code, refusal=error.refusal)
        return Unclear(text)

    def _part(self, begin: int, end: int) -> str:
        """Names the addresses and elements of these requests."""
        (area, start, _), last = self.spans[0], self.spans[-1]
        ends = [*(span.start for span in self.spans), last.start + last.size]
        first, after = ends[begin], ends[end]
        spelt = [self.driver.spell(Address(area, number)) for number in (first, after - 1)]
        text = spelt[0] if first == after - 1 else "..".join(spelt)
        if not self.elements:
            return text
        units = ends[-1] - start
        low, high = ((number - start) * self.elements // units for number in (first, after))
        return (
            f"{text} ({f'element {low}' if high == low + 1 else f'elements {low} to {high - 1}'})"
        )


def long_write(driver: AnyDriver, span: Span, elements: int) -> LongWrite | None:
    """Returns the fewest requests that write the span and nothing else; None: one is enough.

    No request ends inside an element: the PLC would have one half of a number for a while. None
    also where it cannot be done: then the driver says why, or must write addresses around it.
    """
    if driver.write_cost(span) is not None and not writes_around(driver, span):
        return None
    (area, start, size), step = span, 1 if not elements else max(1, span.size // elements)
    spans, at = [], start
    while at < start + size:
        steps = range(1, (start + size - at) // step + 1)
        most = bisect_left(
            steps, True, key=lambda n: driver.write_cost(Span(area, at, n * step)) is None
        )
        if not most:
            return None
        tried = (Span(area, at, n * step) for n in (*range(most, max(1, most - _TRIED), -1), 1))
        fits = next((one for one in tried if not writes_around(driver, one)), None)
        if fits is None:
            return None
        spans.append(fits)
        at += fits.size
    return LongWrite(driver, spans, elements)


def writes_around(driver: AnyDriver, span: Span) -> bool:
    """Returns True if a write of the span also writes addresses around it."""
    return isinstance(driver, WritesAround) and driver.writes_around(span)
