"""Who is at the other end: the links of the session, and when everything is to be told again."""

import asyncio
import time

import structlog
import zenoh

from gateway.northbound.inbox import Inbox
from gateway.northbound.limiter import Limiter

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_REMEMBERED = 256  # lost links


class Links:
    """`returned` is set when a router, or one that was here before, has come."""

    def __init__(self) -> None:
        self.returned = asyncio.Event()
        self._up: dict[str, str] = {}  # what is at the other end, by its session
        self._lost: dict[str, None] = {}  # the sessions of links that went, oldest first
        self._lines = Limiter(100, 1.0)  # anybody can come and go as often as he likes

    def __len__(self) -> int:
        return len(self._up)

    def kinds(self) -> list[str]:
        """`router`, `peer` or `client` for each link."""
        return sorted(self._up.values())

    def declare(self, session: zenoh.Session, inbox: Inbox[zenoh.TransportEvent]) -> object:
        return session.info.declare_transport_events_listener(
            zenoh.handlers.Callback(inbox, indirect=False), history=True
        )

    def take(self, event: zenoh.TransportEvent) -> None:
        """On the event loop."""
        there, what = str(event.transport.zid), str(event.transport.whatami)
        came = event.kind != zenoh.SampleKind.DELETE
        if self._lines.allows(time.monotonic()):
            log.info("Zenoh link up" if came else "Zenoh link down", to=what, id=there)
        if came:
            self._came(there, what)
        else:
            self._up.pop(there, None)
            self._lost[there] = None
            if len(self._lost) > _REMEMBERED:
                del self._lost[next(iter(self._lost))]

    def _came(self, there: str, what: str) -> None:
        self._up[there] = what
        if what == "router" or there in self._lost:
            self._lost.pop(there, None)
            self.returned.set()
