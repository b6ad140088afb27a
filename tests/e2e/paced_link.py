"""A slow network link between a Zenoh client and its gateway: a TCP proxy with a rate and a delay.

    async with paced_link(endpoint, rate=64_000, delay=0.3) as slow:    # bits/s, seconds one way
        async with ZenohPeer("client", connect=[slow.endpoint]) as client: ...

Small socket buffers push back on the sender soon, as a modem does; `large` ones take megabytes, as
those of a tunnel. `loss` delays a segment, and all
behind it, by a round trip, as TCP does when it sends a segment again.
"""

import asyncio
import random
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

UNLIMITED = float("inf")
_SEGMENT = 1460  # bytes
_BUFFER = 8192


@dataclass
class PacedLink:
    """One direction has `rate` bits/s; assign it at any time.

    `carried` counts bytes towards the client.
    """

    endpoint: str
    target: tuple[str, int]
    rate: float
    delay: float = 0.0
    loss: float = 0.0
    large: bool = False
    carried: int = 0
    connections: int = 0
    _chance: random.Random = field(default_factory=lambda: random.Random(1))
    _tasks: set["asyncio.Task[None]"] = field(default_factory=set)

    def accept(self, listener: socket.socket) -> None:
        client, _ = listener.accept()
        self.connections += 1
        task = asyncio.get_running_loop().create_task(self._connect(client))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(lambda _: client.close())  # a task may end before it begins

    async def _connect(self, client: socket.socket) -> None:
        buffered = _large if self.large else _small
        with suppress(ConnectionRefusedError), buffered(socket.socket()) as server:
            await asyncio.get_running_loop().sock_connect(server, self.target)
            client.setblocking(False)
            directions = [
                asyncio.ensure_future(self._carry(client, server, down=False)),
                asyncio.ensure_future(self._carry(server, client, down=True)),
            ]
            try:
                await asyncio.wait(directions, return_when=asyncio.FIRST_COMPLETED)
            finally:  # before the sockets are closed: another one may get their numbers
                for direction in directions:
                    direction.cancel()
                await asyncio.wait(directions)

    async def _carry(self, source: socket.socket, sink: socket.socket, *, down: bool) -> None:
        loop = asyncio.get_running_loop()
        flying: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        landing = loop.create_task(self._land(flying, sink))
        free = loop.time()
        try:
            with suppress(OSError):
                while data := await loop.sock_recv(source, _SEGMENT):
                    free = max(free, loop.time()) + len(data) * 8 / self.rate
                    if self._chance.random() < self.loss:
                        free += 2 * self.delay
                    if free - loop.time() > 0.005:  # a shorter sleep is not exact
                        await asyncio.sleep(free - loop.time())
                    flying.put_nowait((free + self.delay, data))
                    if down:
                        self.carried += len(data)
        finally:
            landing.cancel()

    async def _land(
        self, flying: "asyncio.Queue[tuple[float, bytes]]", sink: socket.socket
    ) -> None:
        loop = asyncio.get_running_loop()
        with suppress(OSError):
            while True:
                at, data = await flying.get()
                if (wait := at - loop.time()) > 0:
                    await asyncio.sleep(wait)
                await loop.sock_sendall(sink, data)

    @property
    def is_busy(self) -> bool:
        """True once more than the greetings of two sessions went to the client."""
        return self.carried > 20_000

    async def cut(self) -> None:
        """Ends all connections; the next one is accepted."""
        for task in list(self._tasks):
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks)


def _small(end: socket.socket) -> socket.socket:
    """Makes the buffers small. A small segment keeps the other end's send buffer small too."""
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, _SEGMENT)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    end.setblocking(False)
    return end


def _large(end: socket.socket) -> socket.socket:
    """Leaves the buffers to the system."""
    end.setblocking(False)
    return end


@asynccontextmanager
async def paced_link(
    endpoint: str,
    rate: float = UNLIMITED,
    delay: float = 0.0,
    loss: float = 0.0,
    *,
    large: bool = False,
) -> AsyncIterator[PacedLink]:
    """`endpoint`: of the gateway or router behind the link."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    with (_large if large else _small)(socket.socket()) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        here = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        link = PacedLink(here, (host, int(port)), rate, delay, loss, large)
        loop = asyncio.get_running_loop()
        loop.add_reader(listener, link.accept, listener)
        try:
            yield link
        finally:
            loop.remove_reader(listener)
            await link.cut()
