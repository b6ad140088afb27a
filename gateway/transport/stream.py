"""A port over anything asyncio calls a transport: bytes straight through, the end told once."""

import asyncio
from contextlib import suppress
from typing import cast

from gateway.errors import LineDown
from gateway.transport.port import Receiver
from gateway.transport.trouble import line_down

# More than this waiting to be sent means that nobody takes it: what waits are old requests, which
# must not reach a machine after they have been reported as failed.
MOST_UNSENT = 4096  # bytes
# asyncio and serialx make room for 256 KiB at every read. Where the system gives that memory anew
# each time, and takes it back, this costs more than the read itself.
MOST_READ = 4096  # bytes
# A driver may hold a port back until it has sent what it has; nobody waits longer for it.
LONGEST_CLOSE = 1.0  # seconds


class StreamPort(asyncio.Protocol):
    """A `Port` that is also the protocol object of its own asyncio transport.

    `Receiver.lost` is called only between `ready` and `close`: whoever opens the port hears of
    an earlier end by the exception of `ready`.
    """

    def __init__(self, name: str, ear: Receiver) -> None:
        self.name = name
        self._ear = ear
        self._live = False
        self._loss: LineDown | None = None
        self._transport: asyncio.Transport | None = None
        self._gone = asyncio.Event()

    def ready(self) -> None:
        """The opening is over. Raises `LineDown` if the port has ended meanwhile."""
        if self._loss is not None:
            raise self._loss
        self._live = True

    def write(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            raise self._ending()
        try:
            transport.write(data)
        except OSError as error:
            raise line_down(self.name, error) from error
        if transport.is_closing():  # asyncio swallows the error of a write that failed
            raise self._ending()

    def _ending(self) -> LineDown:
        # A new one each time: one that is raised again and again drags all its tracebacks along.
        return LineDown(str(self._loss)) if self._loss else line_down(self.name, None)

    async def close(self) -> None:
        self._live = False
        if self._transport is None:
            return
        self._loss = self._loss or LineDown(f"{self.name}: closed")
        self._transport.abort()  # not `close`: nothing may be sent after the port was given back
        with suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_CLOSE):
                await self._gone.wait()

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=MOST_UNSENT)
        if hasattr(transport, "max_size"):  # not of uvloop, which keeps its own
            transport.max_size = MOST_READ

    def data_received(self, data: bytes) -> None:
        self._ear.received(data)

    def pause_writing(self) -> None:
        self._loss = LineDown(f"{self.name}: does not take what is sent")
        if self._transport is not None:
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._loss = self._loss or line_down(self.name, exc)
        self._gone.set()
        if self._live:
            self._live = False
            self._ear.lost(self._loss)
