"""Simulated stations for other programs: on a pseudo terminal, or on a TCP port."""

import asyncio
import os
import tty
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Protocol, cast

from gateway.planning.wire_timing import WireTiming
from gateway.simulator.port import HalfDuplex
from gateway.stations.station import Station
from gateway.transport.os_errors import line_down
from gateway.transport.terminal import put_link, take_link

_MOST_READ = 4096  # bytes
MakeBus = Callable[[Callable[[bytes], None]], HalfDuplex]  # of the function that takes the replies


class Served(Protocol):
    """Stations that other programs can reach."""

    @property
    def address(self) -> str:
        """The text after `port:` that reaches them."""

    async def close(self) -> None: ...


async def serve_on_pty(
    stations: Sequence[Station],
    wire: WireTiming,
    link: str | None = None,
    *,
    turnaround: float = 0.005,
    paced: bool = True,
) -> Served:
    """Serves stations on a pseudo terminal, at the speed of the line; `link` is a link to it.

    A link to another terminal is replaced, anything else at that path is left alone.
    Raises `LineDown`.
    """
    try:
        master, slave = os.openpty()
    except OSError as error:
        raise line_down("pseudo terminal", error) from error
    bus = partial(HalfDuplex, stations, wire, turnaround=turnaround, paced=paced)
    served = _Pty(master, slave, bus)
    if link is not None:
        try:
            served.link(Path(link))
        except OSError as error:
            await served.close()
            raise line_down(link, error) from error
    return served


class _Pty:
    def __init__(self, master: int, slave: int, bus: MakeBus) -> None:
        self._loop = asyncio.get_running_loop()
        self._master = master
        self._slave = slave  # kept open, or the master would end when its first user leaves
        self._name = os.ttyname(slave)
        self.address = self._name
        self._link: Path | None = None
        self._bus = bus(self._deliver)
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._loop.add_reader(master, self._readable)

    def link(self, path: Path) -> None:
        """Raises `OSError`."""
        put_link(path, self._name)
        self._link = path
        self.address = str(path)

    def _readable(self) -> None:
        with suppress(BlockingIOError):
            self._bus.send(os.read(self._master, _MOST_READ))

    def _deliver(self, data: bytes) -> None:
        # The terminal is full because no program reads it: lost, as on a line.
        with suppress(BlockingIOError):
            os.write(self._master, data)

    async def close(self) -> None:
        if self._bus.cut:
            return
        self._bus.close()
        self._loop.remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        if self._link is not None:
            take_link(self._link, self._name)


async def serve_on_tcp(
    stations: Sequence[Station],
    wire: WireTiming,
    host: str,
    port: int,
    *,
    turnaround: float = 0.005,
    paced: bool = True,
) -> Served:
    """Serves stations on a TCP port; port 0 takes a free one. Raises `LineDown`.

    Paced, one line is behind the port as behind a device server: replies go to every connection.
    Not paced (a network protocol), every connection has its own line.
    """
    bus = partial(HalfDuplex, stations, wire, turnaround=turnaround, paced=paced)
    served = _Tcp(bus, shared=paced)
    try:
        await served.listen(host, port)
    except (OSError, OverflowError) as error:  # OverflowError: a port number above 65535
        raise line_down(f"{host}:{port}", error) from error
    return served


class _Tcp:
    def __init__(self, bus: MakeBus, *, shared: bool) -> None:
        self.address = ""
        self._connections: set[_Connection] = set()
        self._server: asyncio.Server | None = None
        self._bus = bus
        self._shared = bus(self._to_all) if shared else None

    async def listen(self, host: str, port: int) -> None:
        """Raises `OSError`."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._connection, host, port)
        name, number = self._server.sockets[0].getsockname()[:2]
        self.address = f"tcp://[{name}]:{number}" if ":" in name else f"tcp://{name}:{number}"

    def _connection(self) -> "_Connection":
        return _Connection(self._connections, self._shared, self._bus)

    def _to_all(self, data: bytes) -> None:
        for connection in self._connections:
            connection.send(data)

    async def close(self) -> None:
        server, self._server = self._server, None
        if server is None:
            return
        server.close()
        if self._shared is not None:
            self._shared.close()
        for connection in list(self._connections):
            await connection.close()
        await server.wait_closed()


class _Connection(asyncio.Protocol):
    def __init__(self, others: "set[_Connection]", shared: HalfDuplex | None, own: MakeBus) -> None:
        self._others = others
        self._shared = shared
        self._bus = shared or own(self.send)
        self._transport: asyncio.Transport | None = None
        self._gone = asyncio.Event()

    def send(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(data)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.abort()
            await self._gone.wait()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._others.add(self)

    def data_received(self, data: bytes) -> None:
        self._bus.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._others.discard(self)
        if self._shared is None:
            self._bus.close()
        self._gone.set()
