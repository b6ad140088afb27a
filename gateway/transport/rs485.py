"""The direction of an RS-485 transceiver, switched by the kernel (Linux, `TIOCSRS485`).

A two-wire transceiver sends or receives. Most adapters switch by themselves; a UART on a board
often needs RTS for it. The kernel switches within microseconds, which no program does in time.
"""

import struct
import sys
from dataclasses import dataclass

from gateway.errors import LineDown

# `struct serial_rs485` of linux/serial.h: flags, both delays in ms, five words of no use here.
_LAYOUT = struct.Struct("=8I")
_GET, _SET = 0x542E, 0x542F
_ENABLED, _RTS_ON_SEND, _RTS_AFTER_SEND, _RX_DURING_TX = 1, 2, 4, 16
LONGEST_DELAY = 0.1  # seconds; the kernel shortens longer ones


@dataclass(frozen=True, slots=True)
class Rs485:
    """Rules by which RTS switches the transceiver. Delays in seconds, whole milliseconds."""

    rts_sends: bool = True  # RTS is on while the port sends; False: while it receives
    before: float = 0.0  # from switching to the first bit
    after: float = 0.0  # from the last bit to switching back
    hears_itself: bool = False  # the receiver stays on: the port gets its own requests

    def packed(self) -> bytes:
        """Returns the kernel's structure."""
        flags = _ENABLED | (_RTS_ON_SEND if self.rts_sends else _RTS_AFTER_SEND)
        flags |= _RX_DURING_TX if self.hears_itself else 0
        return _LAYOUT.pack(flags, round(self.before * 1e3), round(self.after * 1e3), *[0] * 5)


def set_direction(name: str, port: int, wanted: Rs485) -> None:
    """Has the kernel switch the transceiver at an open port. Raises `LineDown`.

    `port`: a file descriptor. A driver may change what it cannot do; so it is asked afterwards.
    """
    if sys.platform != "linux":
        raise LineDown(f"{name}: `rs485` needs Linux: use an adapter that switches by itself")
    import fcntl

    asked = wanted.packed()
    try:
        fcntl.ioctl(port, _SET, asked)
        found = fcntl.ioctl(port, _GET, bytes(_LAYOUT.size))
    except OSError as error:
        raise LineDown(
            f"{name}: its driver does not switch RS-485 ({error.strerror}): remove `rs485` if the "
            "adapter switches by itself, or use another adapter"
        ) from error
    if found[:12] != asked[:12]:
        flags, before, after = struct.unpack_from("=3I", found)
        raise LineDown(
            f"{name}: its driver does not switch RS-485 as `rs485` says: it has flags {flags:#x}, "
            f"before {before} ms, after {after} ms"
        )
