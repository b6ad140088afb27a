"""Opens TCP connections that detect a dead peer within a minute."""

import asyncio
import errno
import socket

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import KEEPALIVE, Reach, Receiver, TcpAddress, named
from gateway.transport.stream import StreamPort
from gateway.transport.tls import begin_tls, make_context, watch

# A peer without power sends nothing. After the silence of `keepalive` the system sends three times,
# and waits half of it each time. Sent data must be acknowledged as soon, or the line is down. The
# names differ between systems: names that this system lacks are left out.
_OPTIONS = {
    "TCP_KEEPIDLE": 1.0,  # of `keepalive`, in seconds
    "TCP_KEEPALIVE": 1.0,  # the name on macOS
    "TCP_KEEPINTVL": 0.5,
    "TCP_USER_TIMEOUT": 2500.0,  # in milliseconds; Linux only
}
_TRIES = 3


async def open_tcp(
    where: TcpAddress, receiver: Receiver, *, timeout: float = 5.0, baudrate: int = 0
) -> StreamPort:
    """Connects to a device server or network device, by the first of its addresses that works.
    Raises `LineDown`.

    `baudrate`: of the wire behind it; 0: not known. Each address gets its share of the time.
    """
    by, failed = asyncio.get_running_loop().time() + timeout, list[str]()
    places = ((where.host, where.port), *where.reach.others)
    for left, place in zip(range(len(places), 0, -1), places, strict=True):
        share = (by - asyncio.get_running_loop().time()) / left
        port = StreamPort(named(*place), receiver, baudrate)
        try:
            await _connect(port, place, where, share)
        # UnicodeError: an invalid host name, for example with an empty label.
        except (OSError, UnicodeError, LineDown) as error:
            await port.close()
            failed.append(str(line_down(port.name, error, _sentences(where.reach))))
            cause: Exception = error
        else:
            return port
    raise LineDown("; ".join(failed)) from cause


async def _connect(
    port: StreamPort, place: tuple[str, int], where: TcpAddress, timeout: float
) -> None:
    loop, tls, context = asyncio.get_running_loop(), where.tls, None
    by, bind = loop.time() + timeout, where.reach.bind
    async with asyncio.timeout_at(by):
        if tls is not None:
            context = await asyncio.to_thread(make_context, tls, serves=False)
        transport, _ = await loop.create_connection(
            lambda: port, *place, local_addr=(bind, 0) if bind else None
        )
    configure(transport.get_extra_info("socket"), where.reach.keepalive)
    if tls is not None and context is not None:
        await begin_tls(port, context, within=by - loop.time(), host=tls.name or place[0])
        watch(port, tls)
    port.ready()


def _sentences(reach: Reach) -> dict[int, str]:
    wrong = f"{reach.bind} is not an address of this computer: `bind`"
    return {errno.EADDRNOTAVAIL: wrong} if reach.bind else {}


def configure(connection: socket.socket, keepalive: float = KEEPALIVE) -> None:
    """Sends without delay and detects a dead peer. Raises `OSError`."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    values = {name: max(1, round(factor * keepalive)) for name, factor in _OPTIONS.items()}
    for name, value in {**values, "TCP_KEEPCNT": _TRIES}.items():
        option = getattr(socket, name, None)
        if option is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
