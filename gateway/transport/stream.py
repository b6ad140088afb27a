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
# A wire carries no more than its baud rate. A peer that sends more costs all lines their time. A
# device server may deliver at once what it has kept while the link stalled, and the baud rate of
# the file may be lower than its own.
TIMES_THE_WIRE = 4
SLOWEST_RATE = 20_000.0  # bytes per second that every port may deliver
MOST_AT_ONCE = 32_768  # bytes beyond the rate
PER_REQUEST = 4096  # bytes that each request may bring back; network devices have no baud rate
# A driver may close a port only after it has sent its buffer; `close` waits no longer than this.
LONGEST_CLOSE = 1.0  # seconds


class Allowance:
    """The bytes that a peer may send: as many as a wire carries, and the replies to requests."""

    __slots__ = ("_begun", "_bytes", "_level", "_now", "_rate")

    def __init__(self, baudrate: int) -> None:
        self._rate = max(SLOWEST_RATE, TIMES_THE_WIRE * baudrate / 10)
        self._level = 0.0  # bytes beyond the rate
        self._now = self._begun = 0.0
        self._bytes = 0  # since `begun`, when the level was zero

    def requested(self) -> None:
        """Allows the reply to one more request."""
        self._level -= PER_REQUEST  # `received` begins at 0 again: no request is saved up

    def received(self, size: int, now: float) -> float:
        """Notes received bytes. Returns the bytes per second if they are too many, else 0."""
        level = self._level - (now - self._now) * self._rate
        if level <= 0.0:
            level, self._begun, self._bytes = 0.0, now, 0
        self._level, self._now = level + size, now
        self._bytes += size
        if self._level <= MOST_AT_ONCE:
            return 0.0
        return self._bytes / max(now - self._begun, 0.01)


class StreamPort(asyncio.Protocol):
    """A `Port` that is also the protocol object of its own asyncio transport.

    `Receiver.lost` is called only between `ready` and `close`. `ready` raises the exception of an
    earlier loss.
    """

    def __init__(self, name: str, receiver: Receiver, baudrate: int = 0) -> None:
        """`baudrate`: of the wire behind the port; 0: not known."""
        self.name = name
        self._allowance = Allowance(baudrate)
        self._receiver = receiver
        self._is_open = False
        self._loss: LineDown | None = None
        self._transport: asyncio.Transport | None = None
        self._now = asyncio.get_running_loop().time  # each question for the loop is a system call
        self._closed = asyncio.Event()
        self.watching: asyncio.Task[None] | None = None  # the certificate of the other side

    def ready(self) -> None:
        """Ends the opening. Raises `LineDown` when the port was lost meanwhile."""
        if self._loss is not None:
            raise self._loss
        self._is_open = True

    @property
    def transport(self) -> asyncio.Transport | None:
        """The transport, for the signals of a serial port, and the certificate of the peer."""
        return self._transport

    def expects(self, baudrate: int) -> None:
        """Notes another baud rate of the wire behind the port."""
        self._allowance = Allowance(baudrate)

    def descriptor(self) -> int:
        """Returns the file descriptor of an open serial port. Raises `LineDown`."""
        if self._transport is None or self._loss is not None:
            raise self._line_down()
        return int(self._transport.get_extra_info("serial").fileno())

    def write(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            raise self._line_down()
        self._allowance.requested()
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

    async def is_lost(self, within: float) -> bool:
        """Waits for the end of the connection, `within` seconds at most."""
        with suppress(TimeoutError):
            async with asyncio.timeout(within):
                await self._closed.wait()
        return self._closed.is_set()

    # Called by asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.use(transport)

    def use(self, transport: asyncio.BaseTransport) -> None:
        """Sends and receives by this transport from now on: once more where TLS has begun."""
        self._transport = cast(asyncio.Transport, transport)
        self._transport.set_write_buffer_limits(high=MOST_UNSENT)
        if hasattr(transport, "max_size"):  # uvloop has its own
            transport.max_size = MOST_READ

    def data_received(self, data: bytes) -> None:
        rate = self._allowance.received(len(data), self._now())
        if rate:
            self.break_off(f"pours {rate:.0f} bytes/s: more than the wire can carry")
            return
        self._receiver.received(data)

    def pause_writing(self) -> None:
        self.break_off("the other side accepts no data")

    def break_off(self, why: str) -> None:
        """Ends the connection; its receiver is told why."""
        self._loss = self._loss or LineDown(f"{self.name}: {why}")
        if self._transport is not None:
            self._transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._loss = self._loss or line_down(self.name, exc)
        self._closed.set()
        if self._is_open:
            self._is_open = False
            self._receiver.lost(self._loss)
