"""A TCP proxy that carries only so many bytes a second, as a narrow link does."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

UNLIMITED = float("inf")
BUFFER = 16 * 1024  # bytes that the proxy itself holds: a link keeps little
_SLICE = 0.02  # seconds between two portions


class Pacing:
    """One narrow link. `rate`: bytes a second in each direction; assign it at any time."""

    def __init__(self, target: int, rate: float = UNLIMITED) -> None:
        self.rate = rate
        self.port = 0
        self._target = target
        self._writers: list[asyncio.StreamWriter] = []

    def cut(self) -> None:
        """Closes every connection; the next one is accepted."""
        for writer in self._writers:
            writer.close()
        self._writers.clear()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            far_reader, far_writer = await self._connected()
        except OSError:
            writer.close()
            return
        self._writers += [writer, far_writer]
        await asyncio.gather(
            self._carry(reader, far_writer), self._carry(far_reader, writer), return_exceptions=True
        )

    async def _connected(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        near = socket.socket()
        near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
        near.setblocking(False)
        await asyncio.get_running_loop().sock_connect(near, ("127.0.0.1", self._target))
        return await asyncio.open_connection(sock=near, limit=BUFFER)

    async def _carry(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await source.read(self._portion()):
                sink.write(data)
                await sink.drain()
                await asyncio.sleep(len(data) / self.rate)
        sink.close()

    def _portion(self) -> int:
        return max(1, int(min(BUFFER, self.rate * _SLICE)))


@asynccontextmanager
async def narrow_link(target: int, rate: float = UNLIMITED) -> AsyncIterator[Pacing]:
    """A link to a local port; connect to `port` of the result."""
    link = Pacing(target, rate)
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
    listener.bind(("127.0.0.1", 0))
    server = await asyncio.start_server(link.serve, sock=listener, limit=BUFFER)
    link.port = listener.getsockname()[1]
    try:
        yield link
    finally:
        server.close()
        link.cut()
