"""Raw TCP (device servers, network devices) that notices a dead peer within a minute."""

import asyncio
import socket

from gateway.errors import LineDown
from gateway.transport.port import Receiver, TcpAddress
from gateway.transport.stream import StreamPort
from gateway.transport.trouble import line_down

# A peer that lost its power says nothing. After 20 s of quiet it is asked, every 10 s, three
# times; and what was sent must be acknowledged within 50 s, or the line is down. The names
# differ between systems: those that this one does not have are left out.
_WATCH = {
    "TCP_KEEPIDLE": 20,  # seconds
    "TCP_KEEPALIVE": 20,  # macOS' name for it
    "TCP_KEEPINTVL": 10,  # seconds
    "TCP_KEEPCNT": 3,
    "TCP_USER_TIMEOUT": 50_000,  # milliseconds; Linux only
}


async def open_tcp(where: TcpAddress, ear: Receiver, *, timeout: float = 5.0) -> StreamPort:
    """Connect. Raises `LineDown`."""
    name = f"{where.host}:{where.port}"
    port = StreamPort(name, ear)
    try:
        async with asyncio.timeout(timeout):
            transport, _ = await asyncio.get_running_loop().create_connection(
                lambda: port, where.host, where.port
            )
        watch(transport.get_extra_info("socket"))
        port.ready()
    # UnicodeError: a host name that cannot be looked up, such as one with an empty label.
    except (OSError, UnicodeError, LineDown) as error:
        await port.close()
        raise line_down(name, error) from error
    return port


def watch(connection: socket.socket) -> None:
    """Send at once, and notice a peer that is gone. Raises `OSError`."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _WATCH.items():
        option = getattr(socket, name, None)
        if option is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
