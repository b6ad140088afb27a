"""The monitor list of one device: the addresses that its PLC reads with one short request."""

from dataclasses import dataclass

from gateway.protocols.driver import Span


@dataclass(slots=True)
class MonitorList:
    """The list that the PLC holds, as far as known."""

    registered: tuple[Span, ...] = ()
    allowed: bool = True

    def expect(self, spans: tuple[Span, ...]) -> None:
        """Notes the list that is registered in the PLC next."""
        self.registered = spans

    def forget(self) -> None:
        """Forgets the list: the PLC may have restarted, or another master may have changed it."""
        self.registered = ()

    def allow(self, allowed: bool) -> None:
        """Allows or forbids lists: a PLC that refuses its list is read without one."""
        self.allowed = allowed
