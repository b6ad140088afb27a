"""Both ends of a port in tests: a receiver, the far end of a pty, a station."""

import asyncio
import os
import socket
import termios
import tty
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from gateway.stations.station import Memory
from tests.sim.virtual import VirtualLoop
from tests.zenoh_peer import free_port as free_port

T = TypeVar("T")
PATIENCE = 300.0  # seconds; reached only by a failing test


class RecordingReceiver:
    """A `Receiver` that keeps what it gets; `until` waits for it."""

    def __init__(self, now: Callable[[], float] | None = None) -> None:
        self.data = b""
        self.pieces: list[tuple[float, bytes]] = []
        self.losses: list[Exception] = []
        self._now = now or (lambda: 0.0)
        self._changed = asyncio.Event()

    def received(self, data: bytes) -> None:
        self.data += data
        self.pieces.append((self._now(), data))
        self._changed.set()

    def lost(self, error: Exception) -> None:
        self.losses.append(error)
        self._changed.set()

    async def until(self, happened: Callable[["RecordingReceiver"], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened(self):
                self._changed.clear()
                await self._changed.wait()


class PtyMaster:
    """The test's end of a pty; the port under test opens the other end."""

    def __init__(self) -> None:
        self.fd, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.fd, False)
        self.path = os.ttyname(self.slave)

    def format(self) -> tuple[int, int]:
        """Returns the flags and the speed that the port has set."""
        _, _, cflag, _, _, speed, _ = termios.tcgetattr(self.slave)
        return cflag, speed

    def write(self, data: bytes) -> None:
        os.write(self.fd, data)

    async def read(self, count: int) -> bytes:
        loop, data = asyncio.get_running_loop(), b""
        readable = asyncio.Event()
        loop.add_reader(self.fd, readable.set)
        try:
            async with asyncio.timeout(PATIENCE):
                while len(data) < count:
                    await readable.wait()
                    readable.clear()
                    try:
                        data += os.read(self.fd, 4096)
                    except BlockingIOError:
                        continue
        finally:
            loop.remove_reader(self.fd)
        return data

    def unplug(self) -> None:
        for fd in (self.fd, self.slave):
            if fd >= 0:
                os.close(fd)
        self.fd = self.slave = -1


@contextmanager
def listening(backlog: int = 5) -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0), backlog=backlog) as server:
        server.setblocking(False)
        yield server


class FixedStation:
    """A `Station` that replies to every request with the same frames and keeps the requests."""

    def __init__(self, *frames: bytes, delay: float = 0.0) -> None:
        self.frames = list(frames)
        self.delay = delay
        self.heard: list[tuple[float, bytes]] = []
        self.memory = Memory([])

    def hear(self, data: bytes, now: float) -> list[bytes]:
        self.heard.append((now, data))
        return self.frames


def run_from_zero(play: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Runs `play` on a virtual clock that begins at 0."""
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(0.0)) as runner:
        return runner.run(play())
