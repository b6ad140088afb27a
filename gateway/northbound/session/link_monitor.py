"""The links of the session: counted, logged, and watched for their return."""

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import structlog
import zenoh

from gateway.contract.rate_limit import RateLimit
from gateway.northbound.requests.inbox import Inbox

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_MOST_LOST = 256  # lost links that are remembered
# Seconds. A client that is linked for less, such as a health check, is no event.
_SHORT = 60.0
# Seconds after the start. Sessions that were linked to the process before come back meanwhile.
_RETURNING = 30.0
_NEVER = float("-inf")


@dataclass(slots=True)
class _Link:
    kind: str
    since: float
    address: str = "unknown"


class LinkMonitor:
    """Sets `returned` when a router, or a session that may have been linked before, is linked, and
    `router_lost` when a peer has lost a router."""

    def __init__(
        self, *, is_peer: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """`is_peer`: the mode of the session. Zenoh sends the messages of a peer through one of its
        routers; when this router ends, often none of the others takes over."""
        self._is_peer = is_peer
        self._clock = clock
        self.returned = asyncio.Event()
        self.router_lost = asyncio.Event()
        self._up: dict[str, _Link] = {}  # by the id of the linked session
        self._lost: dict[str, None] = {}  # ids of unlinked sessions, oldest first
        self._started = _NEVER
        self._log_limit = RateLimit(100, 1.0)  # any client can link as often as it likes

    def __len__(self) -> int:
        return len(self._up)

    def kinds(self) -> list[str]:
        """`router`, `peer` or `client` for each link."""
        return sorted(link.kind for link in self._up.values())

    def declare(
        self, session: zenoh.Session, inbox: Inbox[zenoh.TransportEvent | zenoh.LinkEvent]
    ) -> list[object]:
        self._started = self._clock()
        handler = zenoh.handlers.Callback(inbox, indirect=False)
        return [
            session.info.declare_transport_events_listener(handler, history=True),
            session.info.declare_link_events_listener(handler, history=True),
        ]

    def take(self, event: zenoh.TransportEvent | zenoh.LinkEvent, _at: float) -> None:
        """Handles one event on the event loop."""
        is_up = event.kind != zenoh.SampleKind.DELETE
        if isinstance(event, zenoh.LinkEvent):  # the address of a session that is linked
            if is_up and (link := self._up.get(session := str(event.link.zid))) is not None:
                link.address = str(event.link.dst)
                self._log_up(session, link)
            return
        session, kind = str(event.transport.zid), str(event.transport.whatami)
        if is_up:
            self._linked(session, kind)
            return
        if (link := self._up.pop(session, None)) is not None:
            self._log_down(session, link)
            if link.kind == "router" and self._is_peer:
                self.router_lost.set()
        self._lost[session] = None
        if len(self._lost) > _MOST_LOST:
            del self._lost[next(iter(self._lost))]

    def _log_up(self, session: str, link: _Link) -> None:
        if self._log_limit.allows(self._clock()):
            level = logging.DEBUG if link.kind == "client" else logging.INFO
            log.log(level, "Zenoh link up", to=link.kind, address=link.address, id=session)

    def _log_down(self, session: str, link: _Link) -> None:
        """A warning for the last link: no other program sees the values any more."""
        lasted = self._clock() - link.since
        if link.kind == "client" and lasted < _SHORT:
            level = logging.DEBUG
        else:
            level = logging.INFO if self._up else logging.WARNING
        if level == logging.WARNING or self._log_limit.allows(self._clock()):
            log.log(
                level,
                "Zenoh link down",
                to=link.kind,
                address=link.address,
                after=round(lasted),
                left=len(self._up),
                id=session,
            )

    def _linked(self, session: str, kind: str) -> None:
        self._up[session] = _Link(kind, self._clock())
        routers = sum(link.kind == "router" for link in self._up.values())
        if kind == "router" and self._is_peer and routers == 2:
            log.warning(
                "several routers",
                why="in mode peer values may stop when one of them ends: set zenoh.mode to client",
            )
        may_return = self._clock() - self._started < _RETURNING
        if kind == "router" or session in self._lost or may_return:
            self._lost.pop(session, None)
            self.returned.set()
