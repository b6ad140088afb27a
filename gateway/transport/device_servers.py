"""Ports that device servers connect to: `listen://host:port`, one for each registration.

A device server behind a mobile network has no address that anybody could connect to. So it connects
itself, and says who it is by its first bytes, the registration. It may send heartbeats at any time;
they are no bytes of the line.
"""

import asyncio
import socket
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from weakref import WeakKeyDictionary

import structlog

from gateway.errors import LineDown, words_of
from gateway.transport.listen import begin, listening
from gateway.transport.port import (
    LONGEST_REGISTRATION,
    DeviceServer,
    ListenAddress,
    Receiver,
    TlsConfig,
    named,
)
from gateway.transport.stream import Allowance, StreamPort
from gateway.transport.tls import ServerFiles, names_of

log = structlog.get_logger("gateway.line")

REGISTERS_WITHIN = 10.0  # seconds
MOST_UNREGISTERED = 64  # connections; for one more the oldest of the busiest address is closed
SILENT = 5.0  # seconds after which a second connection of a registration replaces the first
ONE_REPLY = 2.0  # seconds between two packets of one reply, at most
UNUSED = 30.0  # seconds without a line until a door closes: a line that reopens needs it again
_LOG_EVERY = 10.0  # seconds
_WAITING = 100  # connections that the system accepts before this process does
_SHOWN = 32  # bytes of a refused registration in the log


class _Nobody:
    """Receives what arrives while no line uses the connection."""

    def received(self, data: bytes) -> None:
        pass

    def lost(self, error: Exception) -> None:
        pass


class _Connection(StreamPort):
    """The connection of one device server; once it is registered, the port of a line."""

    def __init__(self, door: "_Door", address: str) -> None:
        super().__init__(door.name, _Nobody())
        self._door = door
        self.address = address
        self.greeting = b""  # the first bytes
        self.server: DeviceServer | None = None
        self.names: set[str] = set()  # in its certificate
        self.handshake: asyncio.Task[None] | None = None
        self.ended = False
        self.heard_at = asyncio.get_running_loop().time()
        self._answering = False  # bytes arrived since the last request, but heartbeats
        self.ready()

    @property
    def is_open(self) -> bool:
        return self._is_open

    @property
    def has_line(self) -> bool:
        return not isinstance(self._receiver, _Nobody)

    def serve(self, receiver: Receiver, baudrate: int) -> None:
        """Passes what arrives from now on to a line. Raises `LineDown` if it was lost."""
        if self._loss is not None:
            raise self._line_down()
        self._receiver, self._allowance = receiver, Allowance(baudrate)

    def end(self, why: str) -> None:
        """Closes the connection, and tells its line why."""
        self.ended = True
        if self.handshake is not None:
            self.handshake.cancel()
        self.break_off(why)

    def begin(self, connection: socket.socket, files: ServerFiles | None) -> None:
        self.handshake = asyncio.create_task(self._begin(connection, files))

    async def _begin(self, connection: socket.socket, files: ServerFiles | None) -> None:
        try:
            await begin(self, connection, files, REGISTERS_WITHIN)
        except LineDown as error:
            self.handshake = None
            self._door.refuse(self, str(error).removeprefix(f"{self.name}: "))
            self._door.lost(self)
            return
        self.names, self.handshake = names_of(self), None
        if self._door.has_named(self.names):
            self._door.greeted(self)
        else:
            self._door.refuse(self, "its certificate has another name")

    def data_received(self, data: bytes) -> None:
        before, self.heard_at = self.heard_at, asyncio.get_running_loop().time()
        if self.heard_at - before > ONE_REPLY:
            self._answering = False
        if self.server is None:
            self.greeting = (self.greeting + data)[:LONGEST_REGISTRATION]
            self._door.greeted(self)
            return
        rest = _without(self.server.words, data)
        if rest and self._answering:  # the rest of a reply: a heartbeat is not its beginning
            rest = _without((self.server.registration,), data)
        if rest:
            self._answering = True
            super().data_received(rest)

    def write(self, data: bytes) -> None:
        self._answering = False
        super().write(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._door.lost(self)
        super().connection_lost(exc)


@dataclass(eq=False)
class _Door:
    """One port of this machine, and the device servers that are connected to it."""

    where: tuple[str, int]
    tls: TlsConfig | None = None
    files: ServerFiles | None = None
    _accepting: asyncio.Task[None] | None = None
    _opening: asyncio.Lock = field(default_factory=asyncio.Lock)
    _unregistered: dict[_Connection, asyncio.TimerHandle] = field(default_factory=dict)
    _known: dict[DeviceServer, asyncio.Event] = field(default_factory=dict)  # set: it is connected
    _connected: dict[DeviceServer, _Connection] = field(default_factory=dict)
    _second: dict[DeviceServer, _Connection] = field(default_factory=dict)
    _seen: set[DeviceServer] = field(default_factory=set)
    _refused: int = 0  # since the last line of the log
    _logged_at: float = -_LOG_EVERY
    _end: asyncio.TimerHandle | None = None

    @property
    def name(self) -> str:
        return named(*self.where)

    async def connection(self, server: DeviceServer, timeout: float) -> _Connection:
        """Returns its connection, or waits for it. Raises `LineDown`."""
        arrived = self._known.setdefault(server, asyncio.Event())
        if self.files is not None:
            await self.files.context()
        async with self._opening:
            if self._accepting is None:
                where = await listening(*self.where, _WAITING)
                self._accepting = asyncio.create_task(self._accept(where))
        self.keep()
        for one in list(self._unregistered):
            self.greeted(one)
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await arrived.wait()
        if server in self._connected:
            return self._connected[server]
        again = " again" if server in self._seen else ""
        who = f" as {_shown(server.registration)}" if server.registration else ""
        raise LineDown(f"{self.name}: no device server has connected{again}{who}")

    async def _accept(self, where: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        with where:  # closed when the loop no longer watches it
            while True:
                try:
                    connection, address = await loop.sock_accept(where)
                except OSError as error:  # too many open files
                    log.warning("connection refused", port=self.name, why=words_of(error))
                    await asyncio.sleep(_LOG_EVERY)
                    continue
                one = _Connection(self, address[0])
                one.begin(connection, self.files)
                self.connected(one)

    def keep(self) -> None:
        """Stays open for `UNUSED` seconds, and while a line has a connection."""
        if self._end is not None:
            self._end.cancel()
        self._end = asyncio.get_running_loop().call_later(UNUSED, self._end_unused)

    def _end_unused(self) -> None:
        if any(one.has_line for one in self._connected.values()):
            self.keep()
        else:
            self.close()

    def close(self) -> None:
        """Closes the port and its connections. A line that needs it opens it again."""
        if self._end is not None:
            self._end.cancel()
        if self._accepting is not None:
            self._accepting.cancel()
            self._accepting = None
        for one in [*self._unregistered, *self._connected.values(), *self._second.values()]:
            one.end("the port was closed")

    # Called by the connections

    def connected(self, one: _Connection) -> None:
        if len(self._unregistered) >= MOST_UNREGISTERED:
            [(most, _)] = Counter(other.address for other in self._unregistered).most_common(1)
            self.refuse(next(other for other in self._unregistered if other.address == most))
        late = asyncio.get_running_loop().call_later(REGISTERS_WITHIN, self.refuse, one)
        self._unregistered[one] = late

    def greeted(self, one: _Connection) -> None:
        """Registers a connection as soon as its first bytes say who it is.

        What follows the registration is older than any request.
        """
        if one.handshake is not None or one not in self._unregistered:
            return
        found = [
            server
            for server in self._known
            if one.greeting.startswith(server.registration)
            and server.allows(one.address)
            and server.is_named(one.names)
        ]
        if found:
            self._unregistered.pop(one).cancel()
            one.server = max(found, key=lambda server: len(server.registration))
            self._registered(one, one.server)
        elif len(one.greeting) == LONGEST_REGISTRATION:
            self.refuse(one)  # whatever follows, it is a stranger

    def has_named(self, names: set[str]) -> bool:
        return any(server.is_named(names) for server in self._known)

    def lost(self, one: _Connection) -> None:
        if (late := self._unregistered.pop(one, None)) is not None:
            late.cancel()
        if one.server is not None and self._connected.get(one.server) is one:
            del self._connected[one.server]
            self._known[one.server].clear()
            self.keep()
            if (second := self._second.pop(one.server, None)) is not None and second.is_open:
                self._take(second, one.server)

    def _registered(self, one: _Connection, server: DeviceServer) -> None:
        """A device server that lost its power connects again before the system knows that its first
        connection is gone. If the first one still sends, the second is another device server."""
        first = self._connected.get(server)
        if first is None:
            self._take(one, server)
            return
        if (other := self._second.pop(server, None)) is not None:
            other.end("its device server has connected again")
        self._second[server] = one
        loop = asyncio.get_running_loop()
        loop.call_at(first.heard_at + SILENT, self._decide, one, first, first.heard_at)

    def _decide(self, one: _Connection, first: _Connection, heard_at: float) -> None:
        if one.server is None or self._second.get(one.server) is not one:
            return
        if first.heard_at > heard_at:
            del self._second[one.server]
            self.refuse(one)
        else:
            first.end("its device server has connected again")

    def _take(self, one: _Connection, server: DeviceServer) -> None:
        self._connected[server] = one
        self._seen.add(server)
        self._known[server].set()
        who = {"address": one.address, "registration": _shown(server.registration)}
        log.info("device server connected", port=self.name, **who)

    def refuse(self, one: _Connection, why: str = "") -> None:
        if (late := self._unregistered.pop(one, None)) is not None:
            late.cancel()
        if one.ended:  # its handshake ends now
            return
        sent = one.greeting
        if one.server is not None:
            why, sent = "another one with its registration still sends", one.server.registration
        elif not any(server.allows(one.address) for server in self._known):
            why = "no line allows its address"
        else:
            why = why or "no line has its registration"
        one.end(why)
        self._refused += 1
        now = asyncio.get_running_loop().time()
        if now - self._logged_at >= _LOG_EVERY:
            who = {"address": one.address, "sent": _shown(sent[:_SHOWN])}
            log.warning("connection refused", port=self.name, **who, why=why, refused=self._refused)
            self._refused, self._logged_at = 0, now


_doors: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[tuple[str, int], _Door]] = (
    WeakKeyDictionary()
)


async def open_listen(
    where: ListenAddress, receiver: Receiver, *, timeout: float = 5.0, baudrate: int = 0
) -> StreamPort:
    """Returns the connection of a device server, or waits for it. Raises `LineDown`.

    `baudrate`: of the wire behind it; 0: not known.
    """
    doors = _doors.setdefault(asyncio.get_running_loop(), {})
    place = (where.host, where.port)
    door = doors.setdefault(place, _Door(place))
    if door.tls != where.tls:
        door.tls, door.files = where.tls, None if where.tls is None else ServerFiles(where.tls)
    port = await door.connection(where.server, timeout)
    port.serve(receiver, baudrate)
    return port


def close_doors() -> None:
    """Closes every port that device servers connect to, in this event loop."""
    for door in _doors.pop(asyncio.get_running_loop(), {}).values():
        door.close()


def _without(words: Sequence[bytes], data: bytes) -> bytes:
    """Returns the data without the words that begin it."""
    while word := next((one for one in words if one and data.startswith(one)), b""):
        data = data[len(word) :]
    return data


def _shown(data: bytes) -> str:
    """Returns bytes as the file writes them: `DTU-0042<CR>`."""
    return "".join(chr(one) if one in _PLAIN else f"<{one:02X}>" for one in data)


_PLAIN = {*range(0x20, 0x7F)} - {*b"<>{}\\"}
