"""Opens TCP connections that detect a dead peer within a minute."""

import asyncio
import socket

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import Receiver, TcpAddress
from gateway.transport.stream import StreamPort
from gateway.transport.tls import begin_tls, make_context

# A peer without power sends nothing. After 20 s of silence the system sends a keep-alive three
# times, every 10 s. Sent data must be acknowledged within 50 s, or the line is down. The names
# differ between systems: names that this system lacks are left out.
KEEPALIVE = {
    "TCP_KEEPIDLE": 20,  # seconds
    "TCP_KEEPALIVE": 20,  # the name on macOS
    "TCP_KEEPINTVL": 10,  # seconds
    "TCP_KEEPCNT": 3,
    "TCP_USER_TIMEOUT": 50_000,  # milliseconds; Linux only
}


async def open_tcp(
    where: TcpAddress, receiver: Receiver, *, timeout: float = 5.0, baudrate: int = 0
) -> StreamPort:
    """Connects to a device server or network device. Raises `LineDown`.

    `baudrate`: of the wire behind it; 0: not known.
    """
    name, loop = f"{where.host}:{where.port}", asyncio.get_running_loop()
    port, by = StreamPort(name, receiver, baudrate), loop.time() + timeout
    tls, context = where.tls, None
    try:
        async with asyncio.timeout_at(by):
            if tls is not None:
                context = await asyncio.to_thread(make_context, tls, serves=False)
            transport, _ = await loop.create_connection(lambda: port, where.host, where.port)
        configure(transport.get_extra_info("socket"))
        if tls is not None and context is not None:
            await begin_tls(port, context, within=by - loop.time(), host=tls.name or where.host)
        port.ready()
    # UnicodeError: an invalid host name, for example with an empty label.
    except (OSError, UnicodeError, LineDown) as error:
        await port.close()
        raise line_down(name, error) from error
    return port


def configure(connection: socket.socket) -> None:
    """Sends without delay and detects a dead peer. Raises `OSError`."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in KEEPALIVE.items():
        option = getattr(socket, name, None)
        if option is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
