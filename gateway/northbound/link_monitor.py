"""The links of the session: counted, logged, and watched for their return."""

import asyncio
import time

import structlog
import zenoh

from gateway.northbound.inbox import Inbox
from gateway.northbound.rate_limit import RateLimit

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_MOST_LOST = 256  # lost links that are remembered
# Seconds after the start. Sessions that were linked to the process before come back meanwhile.
_RETURNING = 30.0
_NEVER = float("-inf")


class LinkMonitor:
    """Sets `returned` when a router, or a session that may have been linked before, is linked."""

    def __init__(self, *, is_peer: bool = False) -> None:
        """`is_peer`: the mode of the session. Zenoh sends the messages of a peer through one of its
        routers; when this router ends, often none of the others takes over."""
        self._is_peer = is_peer
        self.returned = asyncio.Event()
        self._up: dict[str, str] = {}  # kind of each linked session, by its id
        self._lost: dict[str, None] = {}  # ids of unlinked sessions, oldest first
        self._started = _NEVER
        self._log_limit = RateLimit(100, 1.0)  # any client can link as often as it likes

    def __len__(self) -> int:
        return len(self._up)

    def kinds(self) -> list[str]:
        """`router`, `peer` or `client` for each link."""
        return sorted(self._up.values())

    def declare(self, session: zenoh.Session, inbox: Inbox[zenoh.TransportEvent]) -> object:
        self._started = time.monotonic()
        return session.info.declare_transport_events_listener(
            zenoh.handlers.Callback(inbox, indirect=False), history=True
        )

    def take(self, event: zenoh.TransportEvent, _at: float) -> None:
        """Handles one event on the event loop."""
        session, kind = str(event.transport.zid), str(event.transport.whatami)
        is_up = event.kind != zenoh.SampleKind.DELETE
        if self._log_limit.allows(time.monotonic()):
            log.info("Zenoh link up" if is_up else "Zenoh link down", to=kind, id=session)
        if is_up:
            self._linked(session, kind)
        else:
            self._up.pop(session, None)
            self._lost[session] = None
            if len(self._lost) > _MOST_LOST:
                del self._lost[next(iter(self._lost))]

    def _linked(self, session: str, kind: str) -> None:
        self._up[session] = kind
        if kind == "router" and self._is_peer and list(self._up.values()).count("router") == 2:
            log.warning(
                "several routers",
                why="in mode peer values may stop when one of them ends: set zenoh.mode to client",
            )
        may_return = time.monotonic() - self._started < _RETURNING
        if kind == "router" or session in self._lost or may_return:
            self._lost.pop(session, None)
            self.returned.set()
