"""A port on any asyncio transport: passes bytes through and reports its loss once."""

import asyncio
from contextlib import suppress
from typing import cast

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import Receiver

# More unsent bytes mean that the other side reads nothing. They are old requests, which must not
# reach a machine after the line has reported them as failed.
MOST_UNSENT = 4096  # bytes
# asyncio and serialx allocate 256 KiB for every read. On some systems the allocation costs more
# than the read itself.
MOST_READ = 4096  # bytes
# A driver may close a port only after it has sent its buffer; `close` waits no longer than this.
LONGEST_CLOSE = 1.0  # seconds


class StreamPort(asyncio.Protocol):
    """A `Port` that is also the protocol object of its own asyncio transport.

    `Receiver.lost` is called only between `ready` and `close`. `ready` raises the exception of an
    earlier loss.
    """

    def __init__(self, name: str, receiver: Receiver) -> None:
        self.name = name
        self._receiver = receiver
        self._is_open = False
        self._loss: LineDown | None = None
        self._transport: asyncio.Transport | None = None
        self._closed = asyncio.Event()

    def ready(self) -> None:
        """Ends the opening. Raises `LineDown` when the port was lost meanwhile."""
        if self._loss is not None:
            raise self._loss
        self._is_open = True

    def write(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            raise self._line_down()
        try:
            transport.write(data)
        except OSError as error:
            raise line_down(self.name, error) from error
        if transport.is_closing():  # asyncio swallows the error of a write that failed
            raise self._line_down()

    def _line_down(self) -> LineDown:
        # A new one each time: an exception raised again and again collects tracebacks.
        return LineDown(str(self._loss)) if self._loss else line_down(self.name, None)

    async def close(self) -> None:
        self._is_open = False
        if self._transport is None:
            return
        self._loss = self._loss or LineDown(f"{self.name}: closed")
        self._transport.abort()  # not `close`: that would send the buffer first
        with suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_CLOSE):
                await self._closed.wait()

    # Called by asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=MOST_UNSENT)
        if hasattr(transport, "max_size"):  # uvloop has its own
            transport.max_size = MOST_READ

    def data_received(self, data: bytes) -> None:
        self._receiver.received(data)

    def pause_writing(self) -> None:
        self._loss = LineDown(f"{self.name}: the other side accepts no data")
        if self._transport is not None:
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._loss = self._loss or line_down(self.name, exc)
        self._closed.set()
        if self._is_open:
            self._is_open = False
            self._receiver.lost(self._loss)
