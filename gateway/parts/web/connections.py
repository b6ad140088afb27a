"""The connections of the HTTP server: beyond a limit the idlest is closed for a new one.

A connection is idle while it has no open request. The number of open requests is bounded by
`places`, and less than that of connections: so there is always an idle one to close. It is one of
the client with the most connections: a client that opens thousands takes them from itself.
"""

import asyncio
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

from aiohttp import web

MOST_CONNECTIONS = 256


class Connections:
    """The open connections, the longest idle first. On the event loop."""

    def __init__(self) -> None:
        self._idle: dict[asyncio.Transport, str] = {}  # with the address of its client
        self._busy: dict[asyncio.Transport, str] = {}

    def wrapped(self, protocol: asyncio.Protocol) -> asyncio.Protocol:
        """Returns the protocol of a new connection, which reports its begin and end."""
        return _Connection(self, protocol)

    def opened(self, transport: asyncio.Transport) -> None:
        if len(self._idle) + len(self._busy) >= MOST_CONNECTIONS:
            self._close_idlest()
        self._idle[transport] = client_of(transport)

    def closed(self, transport: asyncio.Transport) -> None:
        self._idle.pop(transport, None)
        self._busy.pop(transport, None)

    @contextmanager
    def busy(self, transport: asyncio.Transport | None) -> Iterator[None]:
        """Keeps the connection open while it has an open request."""
        client = self._idle.pop(transport, None) if transport is not None else None
        if transport is None or client is None:
            yield  # it was closed
            return
        self._busy[transport] = client
        try:
            yield
        finally:
            if self._busy.pop(transport, None) is not None:
                self._idle[transport] = client

    def _close_idlest(self) -> None:
        """Closes one of the client that has the most idle connections."""
        if not self._idle:
            return
        [(most, _)] = Counter(self._idle.values()).most_common(1)
        idlest = next(one for one, client in self._idle.items() if client == most)
        del self._idle[idlest]
        idlest.abort()


class _Connection(asyncio.Protocol):
    """One connection: reports its begin and end, and passes everything on."""

    def __init__(self, connections: Connections, protocol: asyncio.Protocol) -> None:
        self._connections = connections
        self._transport: asyncio.Transport | None = None
        self._end = protocol.connection_lost
        self._begin = protocol.connection_made
        self.data_received = protocol.data_received  # type: ignore[method-assign]
        self.eof_received = protocol.eof_received  # type: ignore[method-assign]
        self.pause_writing = protocol.pause_writing  # type: ignore[method-assign]
        self.resume_writing = protocol.resume_writing  # type: ignore[method-assign]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's has another base class
        self._connections.opened(self._transport)
        self._begin(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._transport is not None:
            self._connections.closed(self._transport)
        self._end(exc)


def client_of(transport: asyncio.BaseTransport | None) -> str:
    """Returns the address of the client; empty if the connection was closed."""
    peer = transport.get_extra_info("peername") if transport is not None else None
    return str(peer[0]) if peer else ""


class Places:
    """A number of places, and how many of them one client may have."""

    def __init__(self, most: int, of_client: int, called: str) -> None:
        """`called`: what takes them, such as `requests`."""
        self._most = most
        self._of_client = of_client
        self._called = called
        self._taken: Counter[str] = Counter()

    @contextmanager
    def taken(self, client: str) -> Iterator[None]:
        """Takes a place. Raises `HTTPServiceUnavailable` if there is none."""
        if self._taken.total() >= self._most:
            raise web.HTTPServiceUnavailable(reason=f"{self._most} {self._called} are open already")
        if self._taken[client] >= self._of_client:
            reason = f"{self._of_client} {self._called} of this address are open already"
            raise web.HTTPServiceUnavailable(reason=reason)
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]
