"""Accepts TCP connections on a port of this machine."""

import asyncio
import socket
from collections.abc import Callable
from typing import Protocol

import structlog

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import Port, Receiver, TcpAddress, named
from gateway.transport.stream import StreamPort
from gateway.transport.tcp import configure
from gateway.transport.tls import ServerFiles, not_begun, watch

log = structlog.get_logger("gateway.line")
MOST_CONNECTIONS = 32
_BUSY = 10.0  # seconds since its last bytes for which a connection is not closed for another one
_HANDSHAKE = 5.0  # seconds for TLS to begin
_LOG_EVERY = 10.0  # seconds between two refused certificates in the log
_WAITING = 8  # connections that the system accepts before this process does


class Connected(Receiver, Protocol):
    """One connection, on this side."""

    def opened(self, port: Port) -> None:
        """Called before the first bytes."""


class Listener:
    """A port of this machine that other programs connect to."""

    def __init__(self, where: TcpAddress) -> None:
        self._name = named(where.host, where.port)
        self._where = where
        self._socket: socket.socket | None = None
        self._ports: set[_Accepted] = set()
        self._files = None if where.tls is None else ServerFiles(where.tls)
        self._logged_at = 0.0

    async def open(self) -> None:
        """Raises `LineDown`."""
        self._logged_at = asyncio.get_running_loop().time() - _LOG_EVERY
        if self._files is not None:
            await self._files.context()
        self._socket = await listening(self._where.host, self._where.port, _WAITING)

    async def serve(self, connect: Callable[[str], Connected | None]) -> None:
        """Accepts connections until cancelled. `connect` makes the receiver of each, from the
        address of the other side; None: it is closed at once."""
        if self._socket is None:
            raise LineDown(f"{self._name}: not open")
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, address = await loop.sock_accept(self._socket)
            except OSError as error:
                raise line_down(self._name, error) from error
            if (receiver := connect(address[0])) is None:
                connection.close()
            else:
                await self._accept(connection, receiver)

    async def _accept(self, connection: socket.socket, receiver: Connected) -> None:
        loop = asyncio.get_running_loop()
        if len(self._ports) >= MOST_CONNECTIONS:
            idlest = min(
                self._ports, key=lambda port: (port.heard_at > port.opened_at, port.heard_at)
            )
            why, busy = "too many masters", loop.time() - idlest.heard_at < _BUSY
            if busy and idlest.heard_at > idlest.opened_at:
                log.warning("connection refused", port=self._name, why=why)
                connection.close()
                return
            log.warning("connection closed", port=self._name, why=f"{why}: the idlest goes")
            await idlest.close()
        accepted = _Accepted(self._name, receiver, self._ports)
        accepted.handshake = loop.create_task(self._begin(accepted, connection))
        if self._files is None:  # it begins at once
            await accepted.handshake

    async def _begin(self, accepted: "_Accepted", connection: socket.socket) -> None:
        try:
            await begin(accepted, connection, self._files, _HANDSHAKE)
        except LineDown as error:
            now = asyncio.get_running_loop().time()
            known = now - self._logged_at < _LOG_EVERY or self._files is None
            (log.debug if known else log.warning)("connection refused", why=str(error))
            self._logged_at = self._logged_at if known else now
            self._ports.discard(accepted)
        accepted.handshake = None

    async def close(self) -> None:
        """Closes the port and its connections; never raises."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        for port in list(self._ports):
            await port.close()
        self._ports.clear()


class _Accepted(StreamPort):
    """One connection; the port of its receiver. It is in the list until it is closed or lost."""

    def __init__(self, name: str, receiver: Connected, ports: "set[_Accepted]") -> None:
        super().__init__(name, receiver)
        self._ports = ports
        self._connected = receiver
        self.handshake: asyncio.Task[None] | None = None
        self.opened_at = self.heard_at = asyncio.get_running_loop().time()
        ports.add(self)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self.ready()
        self._connected.opened(self)

    async def close(self) -> None:
        self._ports.discard(self)
        if self.handshake is not None:
            self.handshake.cancel()
        await super().close()

    def data_received(self, data: bytes) -> None:
        self.heard_at = asyncio.get_running_loop().time()
        super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._ports.discard(self)
        super().connection_lost(exc)


async def listening(host: str, port: int, backlog: int) -> socket.socket:
    """Returns a socket that listens. Raises `LineDown`."""
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        family, _, _, _, address = found[0]
        made = socket.create_server(address[:2], family=family, backlog=backlog)
    except (OSError, UnicodeError, OverflowError) as error:
        raise line_down(named(host, port), error) from error
    made.setblocking(False)
    return made


async def begin(
    port: StreamPort, connection: socket.socket, files: ServerFiles | None, within: float
) -> None:
    """Begins an accepted connection, with TLS if there are files. Raises `LineDown`, and then it is
    closed. `port` gets its transport when the other side has shown its certificate."""
    begun, loop = False, asyncio.get_running_loop()
    try:
        configure(connection)
        context = None if files is None else await files.context()
        async with asyncio.timeout(within):
            await loop.connect_accepted_socket(
                lambda: port,
                connection,
                ssl=context,
                ssl_handshake_timeout=None if context is None else within + 1.0,
            )
        begun = True
        if files is not None:
            watch(port, files.tls)
    except OSError as error:
        raise not_begun(port.name, error) from error
    finally:
        if not begun:
            connection.close()
