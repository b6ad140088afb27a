"""Opens local serial ports through serialx, exclusively and without blocking the event loop."""

import asyncio
import errno
import os
import sys
from pathlib import Path

import serialx

from gateway.errors import LineDown
from gateway.transport.os_errors import line_down
from gateway.transport.port import Port, Receiver, SerialPath, SerialSettings
from gateway.transport.rs485 import set_direction
from gateway.transport.stream import StreamPort

_SENTENCES = {
    errno.ENOENT: "no such port",
    errno.ENODEV: "no such port",
    errno.ENXIO: "no such port",
    errno.ENOTDIR: "no such port",
    errno.ENOTTY: "not a serial port",
    errno.EISDIR: "not a serial port",
    errno.EACCES: "permission denied: is the user in group dialout?",
    errno.EPERM: "permission denied: is the user in group dialout?",
    errno.EINVAL: "does not support this baud rate and format",
}
_PTYS = range(136, 144)  # Linux' major device numbers of pseudo terminals


async def open_serial(
    where: SerialPath, settings: SerialSettings, receiver: Receiver, *, timeout: float = 5.0
) -> Port:
    """Opens and locks a serial port of this computer. Raises `LineDown`.

    Bytes that the system received before are discarded.
    """
    port = StreamPort(where.path, receiver, settings.baudrate)
    data_bits, parity, stop_bits = tuple(settings.format)
    if await asyncio.to_thread(_is_pty, where.path):
        data_bits, parity = "8", "N"
    try:
        async with asyncio.timeout(timeout):
            await serialx.create_serial_connection(
                asyncio.get_running_loop(),
                lambda: port,
                where.path,
                baudrate=settings.baudrate,
                byte_size=int(data_bits),
                parity=serialx.Parity(parity),
                stopbits=serialx.StopBits(int(stop_bits)),
                exclusive=True,
            )
        if settings.rs485 is not None:
            set_direction(where.path, port.descriptor(), settings.rs485)
        port.ready()
    # ValueError: an invalid path (with a NUL), a format unknown to serialx.
    except (OSError, serialx.SerialException, ValueError, LineDown) as error:
        await port.close()
        raise line_down(where.path, error, _SENTENCES) from error
    return port


def _is_pty(path: str) -> bool:
    """Returns True for a pseudo terminal, which always carries 8 bits without parity.

    Linux accepts another format once and refuses it from then on.
    """
    if sys.platform != "linux":
        return False
    try:
        return os.major(Path(path).stat().st_rdev) in _PTYS
    except (OSError, ValueError):
        return False  # the open that follows gives the reason
