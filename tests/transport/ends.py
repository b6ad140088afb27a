"""The far ends of ports in these tests: ears, ptys, a loop whose time is only counted."""

import asyncio
import os
import selectors
import socket
import termios
import tty
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from gateway.stations.station import Memory

T = TypeVar("T")
PATIENCE = 5.0  # seconds; never waited for when all is well


class Heard:
    """An `Receiver` that remembers; `until` waits for what it should hear."""

    def __init__(self, now: Callable[[], float] | None = None) -> None:
        self.data = b""
        self.pieces: list[tuple[float, bytes]] = []
        self.losses: list[Exception] = []
        self._now = now or (lambda: 0.0)
        self._news = asyncio.Event()

    def received(self, data: bytes) -> None:
        self.data += data
        self.pieces.append((self._now(), data))
        self._news.set()

    def lost(self, error: Exception) -> None:
        self.losses.append(error)
        self._news.set()

    async def until(self, happened: Callable[["Heard"], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened(self):
                self._news.clear()
                await self._news.wait()


class Master:
    """Our end of a pty, while a port has the other."""

    def __init__(self) -> None:
        self.fd, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.fd, False)
        self.path = os.ttyname(self.slave)

    def format(self) -> tuple[int, int]:
        """The flags and the speed the port was set to."""
        _, _, cflag, _, _, speed, _ = termios.tcgetattr(self.slave)
        return cflag, speed

    def write(self, data: bytes) -> None:
        os.write(self.fd, data)

    async def read(self, count: int) -> bytes:
        loop, data = asyncio.get_running_loop(), b""
        news = asyncio.Event()
        loop.add_reader(self.fd, news.set)
        try:
            async with asyncio.timeout(PATIENCE):
                while len(data) < count:
                    await news.wait()
                    news.clear()
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


def free_port() -> int:
    with listening() as server:
        number: int = server.getsockname()[1]
    return number


class Says:
    """A `Station` that answers everything with the same frames, and notes when it heard what."""

    def __init__(self, *frames: bytes, delay: float = 0.0) -> None:
        self.frames = list(frames)
        self.delay = delay
        self.heard: list[tuple[float, bytes]] = []
        self.memory = Memory([])

    def hear(self, data: bytes, now: float) -> list[bytes]:
        self.heard.append((now, data))
        return self.frames


class _Counting(selectors.SelectSelector):
    """Waits for nothing: the time a loop would wait is added to its clock."""

    loop: "CountedLoop"

    def select(self, timeout: float | None = None) -> list[Any]:
        if timeout is None:
            raise RuntimeError("nothing will ever happen")
        self.loop.now += max(timeout, 0.0)
        return []


class CountedLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        selector = _Counting()
        super().__init__(selector)
        selector.loop = self
        self.now = 0.0

    def time(self) -> float:
        return getattr(self, "now", 0.0)

    def run_in_executor(self, *_: Any) -> Any:
        raise RuntimeError("no threads where time is only counted")


def counted(play: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """Run `play` in counted time."""
    with asyncio.Runner(loop_factory=CountedLoop) as runner:
        return runner.run(play())
