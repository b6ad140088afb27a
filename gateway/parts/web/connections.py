"""The connections of the HTTP server: beyond a limit the idlest is closed for a new one.

A connection is idle while it has no open request. The number of open requests is bounded by
`places`, and less than that of connections: so there is always an idle one to close. It is one of
the client with the most connections: a client that opens thousands takes them from itself.
"""

import asyncio
import math
import ssl
from collections import Counter
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from typing import NamedTuple, cast

from aiohttp import web

MOST_CONNECTIONS = 256
HANDSHAKE = 5.0  # seconds
STALLED_AFTER = 1.0  # seconds without a piece taken


class Connections:
    """The open connections, the longest idle first. On the event loop."""

    def __init__(self) -> None:
        self._idle: dict[asyncio.Transport, str] = {}  # with the address of its client
        self._busy: dict[asyncio.Transport, str] = {}

    def wrapped(self, protocol: asyncio.Protocol) -> asyncio.Protocol:
        """Returns the protocol of a new connection, which reports its begin and end."""
        return _Connection(self, protocol)

    def secured(self, protocol: asyncio.Protocol, context: ssl.SSLContext) -> asyncio.Protocol:
        """Returns the protocol of a new connection with TLS."""
        return _Handshake(self, self.wrapped(protocol), context)

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


class _Handshake(asyncio.Protocol):
    """A connection until its handshake has ended. It counts as an idle one."""

    def __init__(
        self, connections: Connections, protocol: asyncio.Protocol, context: ssl.SSLContext
    ) -> None:
        self._connections = connections
        self._protocol = protocol
        self._context = context
        self._early = b""  # a request that came with the end of the handshake
        self._lost = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        plain = cast("asyncio.Transport", transport)
        self._connections.opened(plain)
        self._task = asyncio.get_running_loop().create_task(self._begin(plain))

    def data_received(self, data: bytes) -> None:
        self._early += data

    def connection_lost(self, exc: Exception | None) -> None:
        self._lost = True

    async def _begin(self, plain: asyncio.Transport) -> None:
        try:
            secure = await self._secure(plain)
        except OSError:  # also of TLS
            plain.abort()
            return
        finally:
            self._connections.closed(plain)
        if secure is None or self._lost:
            return
        secure.set_protocol(self._protocol)
        self._protocol.connection_made(secure)
        if self._early:
            self._protocol.data_received(self._early)

    async def _secure(self, plain: asyncio.Transport) -> asyncio.Transport | None:
        """Raises `OSError`."""
        if self._lost:
            return None
        loop = asyncio.get_running_loop()
        starts = loop.create_task(
            loop.start_tls(
                plain, self, self._context, server_side=True, ssl_handshake_timeout=HANDSHAKE
            )
        )
        while plain.get_protocol() is self and not starts.done():
            await asyncio.sleep(0)
        hello, self._early = self._early, b""
        if hello and not starts.done():  # uvloop reads before a task can begin
            handshake = cast("asyncio.BufferedProtocol", plain.get_protocol())
            loop.call_soon(_feed, handshake, hello)
        return await starts


def _feed(protocol: asyncio.BufferedProtocol, data: bytes) -> None:
    while data:
        place = protocol.get_buffer(len(data))
        size = min(len(place), len(data))  # type: ignore[arg-type]  # a memoryview
        place[:size] = data[:size]  # type: ignore[index]
        protocol.buffer_updated(size)
        data = data[size:]


class Who(NamedTuple):
    """The client of a page."""

    name: str  # of its token; empty without a valid one
    may_write: bool  # with a token


class Place:
    """The place of one request, or of one client's stream or search."""

    def __init__(self, transport: asyncio.Transport | None) -> None:
        self.client = client_of(transport)
        self.untaken_since = math.inf  # loop time: a piece waits for the client; inf before that
        self._transport = transport

    def give_up(self) -> None:
        """Closes the connection at once."""
        if self._transport is not None:
            self._transport.abort()


class Places:
    """A number of places, and how many of them one client may have.

    When all are taken, or all of one client, a new request gets the place whose client has taken
    nothing of its answer for the longest time, if that is `STALLED_AFTER` seconds or more.
    """

    def __init__(self, most: int, of_client: int, called: str) -> None:
        """`called`: what takes them, such as `requests`."""
        self._most = most
        self._of_client = of_client
        self._called = called
        self._taken: set[Place] = set()

    @contextmanager
    def taken(self, transport: asyncio.Transport | None) -> Iterator[Place]:
        """Takes a place. Raises `HTTPServiceUnavailable` if there is none."""
        place = Place(transport)
        self._make_room(self._taken, self._most, "are open already")
        of_client = {one for one in self._taken if one.client == place.client}
        self._make_room(of_client, self._of_client, "of this address are open already")
        self._taken.add(place)
        try:
            yield place
        finally:
            self._taken.discard(place)

    def _make_room(self, taken: AbstractSet[Place], most: int, why: str) -> None:
        if len(taken) < most:
            return
        stalled = min(taken, key=lambda one: one.untaken_since)
        if asyncio.get_running_loop().time() - stalled.untaken_since < STALLED_AFTER:
            raise web.HTTPServiceUnavailable(reason=f"{most} {self._called} {why}")
        self._taken.remove(stalled)
        stalled.give_up()
