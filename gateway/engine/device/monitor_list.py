"""The monitor list of one device: the addresses that its PLC reads with one short request."""

import math
from dataclasses import dataclass

from gateway.protocols.driver import Span

REFUSED_FOR = 3600.0  # seconds


@dataclass(slots=True)
class MonitorList:
    """The list that the PLC holds, as far as known."""

    registered: tuple[Span, ...] = ()
    allowed: bool = True
    again: float = math.inf  # when it is allowed again, after it was refused

    def must_register(self, spans: tuple[Span, ...]) -> bool:
        """Notes the list that is read next. Returns True if it must be registered first."""
        known, self.registered = self.registered, spans
        return known != spans

    def forget(self) -> None:
        """Forgets the list: the PLC may have restarted, or another master may have changed it."""
        self.registered = ()

    def refused(self, now: float) -> None:
        """Forbids lists: a PLC that refuses its list is read without one for an hour."""
        self.forbid(now + REFUSED_FOR)

    def forbid(self, until: float) -> None:
        """Forbids lists, at least until then."""
        again = until if self.allowed else max(until, self.again)
        self.allowed, self.again = False, again

    def allow(self) -> None:
        """Allows lists again."""
        self.allowed, self.again = True, math.inf
