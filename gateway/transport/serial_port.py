"""Local serial ports, by serialx: opened exclusively, never blocking the event loop."""

import asyncio
import errno
import os
import sys
from pathlib import Path

import serialx

from gateway.errors import LineDown
from gateway.transport.port import Port, Receiver, SerialPath, SerialSettings
from gateway.transport.stream import StreamPort
from gateway.transport.trouble import line_down

_SENTENCES = {
    errno.ENOENT: "no such port",
    errno.ENODEV: "no such port",
    errno.ENXIO: "no such port",
    errno.ENOTDIR: "no such port",
    errno.ENOTTY: "not a serial port",
    errno.EISDIR: "not a serial port",
    errno.EACCES: "permission denied: is the user in group dialout?",
    errno.EPERM: "permission denied: is the user in group dialout?",
    errno.EINVAL: "does not take this baud rate and format",
}
_PTYS = range(136, 144)  # Linux' major device numbers of pseudo terminals


async def open_serial(
    where: SerialPath, settings: SerialSettings, ear: Receiver, *, timeout: float = 5.0
) -> Port:
    """Open and lock a serial port of this computer. Raises `LineDown`.

    What the system had received before is thrown away.
    """
    port = StreamPort(where.path, ear)
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
        port.ready()
    # ValueError: a path that no system takes (a NUL in it), a format that serialx does not know.
    except (OSError, serialx.SerialException, ValueError, LineDown) as error:
        await port.close()
        raise line_down(where.path, error, _SENTENCES) from error
    return port


def _is_pty(path: str) -> bool:
    """A pseudo terminal always carries 8 bits without parity. Asked for anything else, Linux
    agrees the first time and refuses from then on, so it is not asked."""
    if sys.platform != "linux":
        return False
    try:
        return os.major(Path(path).stat().st_rdev) in _PTYS
    except (OSError, ValueError):
        return False  # opening it will say why
