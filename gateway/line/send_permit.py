"""The rule that a write of the past is not sent: a gateway that was held has lost its duty."""

from collections.abc import Callable

from gateway.line.arrival import NEVER

# Seconds after a hold. What waited in the system arrives meanwhile, and its age is unknown.
SETTLE = 1.0
# Seconds. Another gateway of a standby group is active 3.7 s after this one stops, or later.
PROOF_VALID = 2.0


class SendPermit:
    """Says why a write or command must not be sent now. All times are those of the event loop."""

    def __init__(
        self, released: Callable[[], float] = lambda: -NEVER, *, shared: bool = False
    ) -> None:
        """`released`: the end of the last hold of the process. `shared`: by a standby group, so
        that the duty counts only while it is proven."""
        self._released = released
        self._proven = -NEVER if shared else NEVER

    def prove(self, now: float) -> None:
        """Notes that no other gateway of the standby group is active."""
        self._proven = now

    def why_not(self, since: float, now: float) -> str:
        """Returns the reason to refuse a request that arrived at `since`; empty: it may be sent."""
        if since < self._released() + SETTLE:
            return "the gateway stood still meanwhile; not sent: decide again, then write again"
        if now - self._proven > PROOF_VALID:
            return "another gateway of the standby group may be active; not sent"
        return ""
