"""Modbus over UDP: each datagram is one frame."""

import asyncio
from contextlib import suppress
from struct import Struct
from typing import cast

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import Receiver, UdpAddress, named
from gateway.transport.stream import LONGEST_CLOSE, Allowance

_LENGTH = Struct(">4xH")  # of an MBAP header: the bytes from here on


async def open_udp(where: UdpAddress, receiver: Receiver, *, timeout: float = 5.0) -> "UdpPort":
    """Opens a socket that hears this address alone. Raises `LineDown`.

    It says nothing about the device: whether one is there shows the first reply.
    """
    port = UdpPort(named(where.host, where.port), receiver)
    try:
        async with asyncio.timeout(timeout):
            await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: port, remote_addr=(where.host, where.port)
            )
    # UnicodeError: an invalid host name, for example with an empty label.
    except (OSError, UnicodeError) as error:
        await port.close()
        raise line_down(port.name, error) from error
    return port


class UdpPort(asyncio.DatagramProtocol):
    """A `Port` that is also the protocol object of its own asyncio transport."""

    def __init__(self, name: str, receiver: Receiver) -> None:
        self.name = name
        self._receiver = receiver
        self._allowance = Allowance(0)
        self._transport: asyncio.DatagramTransport | None = None
        self._loss: LineDown | None = None
        self._closed = asyncio.Event()

    def write(self, data: bytes) -> None:
        if self._transport is None or self._loss is not None:
            raise LineDown(str(self._loss or f"{self.name}: closed"))
        self._allowance.requested()
        self._transport.sendto(data)
        if self._loss is not None:  # the system had no way to send it
            raise LineDown(str(self._loss))

    async def close(self) -> None:
        self._loss = self._loss or LineDown(f"{self.name}: closed")
        if self._transport is None:
            return
        self._transport.abort()
        with suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_CLOSE):
                await self._closed.wait()

    # Called by asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: object) -> None:
        rate = self._allowance.received(len(data), asyncio.get_running_loop().time())
        if rate:
            self._lose(LineDown(f"{self.name}: pours {rate:.0f} bytes/s: more than it was asked"))
        elif self._loss is None and _is_whole(data):
            self._receiver.received(data)

    def pause_writing(self) -> None:
        self._lose(LineDown(f"{self.name}: the system sends no datagrams"))

    def error_received(self, exc: Exception) -> None:
        self._lose(line_down(self.name, exc))

    def connection_lost(self, exc: Exception | None) -> None:
        self._closed.set()
        self._lose(line_down(self.name, exc))

    def _lose(self, loss: LineDown) -> None:
        if self._loss is None:
            self._loss = loss
            self._receiver.lost(loss)


def _is_whole(datagram: bytes) -> bool:
    """Returns False for a part of a frame: the next datagram would be taken for its rest."""
    (length,) = _LENGTH.unpack_from(datagram) if len(datagram) >= _LENGTH.size else (0,)
    return len(datagram) == _LENGTH.size + int(length)
