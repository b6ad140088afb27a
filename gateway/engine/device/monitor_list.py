"""The monitor list of one device: the addresses that its PLC reads with one short request."""

from dataclasses import dataclass

from gateway.protocols.driver import Span


@dataclass(slots=True)
class MonitorList:
    """The list that the PLC holds, as far as known."""

    registered: tuple[Span, ...] = ()
    allowed: bool = True

    def must_register(self, spans: tuple[Span, ...]) -> bool:
        """Notes the list that is read next. Returns True if it must be registered first."""
        known, self.registered = self.registered, spans
        return known != spans

    def forget(self) -> None:
        """Forgets the list: the PLC may have restarted, or another master may have changed it."""
        self.registered = ()

    def allow(self, allowed: bool) -> None:
        """Allows or forbids lists: a PLC that refuses its list is read without one."""
        self.allowed = allowed
