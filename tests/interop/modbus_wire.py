"""Just enough of a line in real time to hold conversations with peers: a `Talk` over bytes."""

import asyncio
import os
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, TypeVar

from gateway.errors import DeviceError, NoReply
from gateway.protocols.driver import AnyDriver
from gateway.stations.station import Station

T = TypeVar("T")
PATIENCE = 10.0  # seconds, the most that mbpoll takes; no peer here takes so long


class Bytes(asyncio.Protocol):
    """Either end of a wire: what is heard goes to `hears`."""

    def __init__(self, hears: Callable[[bytes], None]) -> None:
        self.hears = hears
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.hears(data)

    def write(self, data: bytes) -> None:
        assert self.transport is not None
        self.transport.write(data)


class Pty:
    """One end of a pty pair, without a driver in between."""

    def __init__(self, path: Path, hears: Callable[[bytes], None]) -> None:
        self.hears = hears
        self._fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._fd)
        asyncio.get_running_loop().add_reader(self._fd, self._readable)

    def _readable(self) -> None:
        self.hears(os.read(self._fd, 4096))

    def write(self, data: bytes) -> None:
        assert os.write(self._fd, data) == len(data)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._fd)
        os.close(self._fd)


End = Bytes | Pty


def deaf(data: bytes) -> None:
    """Between turns nobody listens."""


@asynccontextmanager
async def serial_end(path: Path) -> AsyncIterator[Pty]:
    end = Pty(path, deaf)
    try:
        yield end
    finally:
        end.close()


@asynccontextmanager
async def tcp_end(port: int) -> AsyncIterator[Bytes]:
    loop = asyncio.get_running_loop()
    transport, end = await loop.create_connection(lambda: Bytes(deaf), "127.0.0.1", port)
    try:
        yield end
    finally:
        transport.close()


class Turn:
    """One turn: a fresh codec, any number of open questions."""

    may_echo = False

    def __init__(self, end: End, driver: AnyDriver) -> None:
        self._end, self._codec = end, driver.codec()
        self._silence = max(driver.timing.silence, driver.timing.silence_chars * 10 / 19200)
        self._open: list[tuple[Callable[[Any], Any], asyncio.Future[Any]]] = []
        end.hears = self._heard

    async def tell(self, frame: Any) -> None:
        await asyncio.sleep(self._silence)  # the silence is the point
        self._end.write(self._codec.encode(frame))

    async def ask(self, frame: Any, reply: int, answers: Callable[[Any], T | None]) -> T:
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._open.append((answers, future))
        await self.tell(frame)
        try:
            return await asyncio.wait_for(future, PATIENCE)
        except TimeoutError:
            raise NoReply("no answer") from None

    def _heard(self, data: bytes) -> None:
        for frame in self._codec.feed(data):
            for answers, future in self._open:
                if future.done():
                    continue
                try:
                    said = answers(frame)
                except DeviceError as refusal:
                    future.set_exception(refusal)
                    break
                if said is not None:
                    future.set_result(said)
                    break


@asynccontextmanager
async def station_on_pty(path: Path, station: Station) -> AsyncIterator[None]:
    clock = asyncio.get_running_loop().time

    def hear(data: bytes) -> None:
        for answer in station.hear(data, clock()):
            end.write(answer)

    end = Pty(path, hear)
    try:
        yield
    finally:
        end.close()


@asynccontextmanager
async def station_on_tcp(station: Station) -> AsyncIterator[int]:
    """Yields the port."""
    loop = asyncio.get_running_loop()

    def connection() -> Bytes:
        def hear(data: bytes) -> None:
            for answer in station.hear(data, loop.time()):
                end.write(answer)

        end = Bytes(hear)
        return end

    server = await loop.create_server(connection, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
