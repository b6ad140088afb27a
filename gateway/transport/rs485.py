"""The direction of an RS-485 transceiver: switched by the kernel (Linux, `TIOCSRS485`), or by hand.

A two-wire transceiver sends or receives. Most adapters switch by themselves; a UART on a board
often needs RTS for it. The kernel switches within microseconds. A program is later: by hand, each
switch is measured.
"""

import os
import struct
import sys
import time
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
    by_hand: bool = False  # this program switches

    def packed(self) -> bytes:
        """Returns the kernel's structure."""
        flags = _ENABLED | (_RTS_ON_SEND if self.rts_sends else _RTS_AFTER_SEND)
        flags |= _RX_DURING_TX if self.hears_itself else 0
        return _LAYOUT.pack(flags, round(self.before * 1e3), round(self.after * 1e3), *[0] * 5)


def set_direction(name: str, port: int, wanted: Rs485) -> None:
    """Has the transceiver receive, and the kernel switch it if it should. Raises `LineDown`.

    `port`: a file descriptor. A driver may change what it cannot do; so it is asked afterwards.
    """
    if sys.platform != "linux":
        raise LineDown(f"{name}: `rs485` needs Linux: use an adapter that switches by itself")
    import fcntl

    if wanted.by_hand:
        try:
            _switch(port, on=not wanted.rts_sends)
        except OSError as error:
            raise LineDown(f"{name}: its driver has no RTS ({error.strerror})") from error
        return
    asked = wanted.packed()
    try:
        fcntl.ioctl(port, _SET, asked)
        found = fcntl.ioctl(port, _GET, bytes(_LAYOUT.size))
    except OSError as error:
        raise LineDown(
            f"{name}: its driver does not switch RS-485 ({error.strerror}): remove `rs485` if the "
            "adapter switches by itself; else write `by: program`, or use another adapter"
        ) from error
    if found[:12] != asked[:12]:
        flags, before, after = struct.unpack_from("=3I", found)
        raise LineDown(
            f"{name}: its driver does not switch RS-485 as `rs485` says: it has flags {flags:#x}, "
            f"before {before} ms, after {after} ms"
        )


def send_by_hand(port: int, data: bytes, seconds: float, wanted: Rs485) -> float:
    """Switches to sending, sends, and switches back. Blocks. Raises `OSError`.

    `port`: a file descriptor, which it closes. `seconds`: of the characters on the wire. Returns
    the seconds from the last bit, on a wire that nothing holds up, to the end of the switch: with
    `after`, and with what the driver and this computer need.
    """
    import termios

    with os.fdopen(port, "wb", 0) as file:
        try:
            _switch(port, on=wanted.rts_sends)
            time.sleep(wanted.before)
            ends = time.monotonic() + seconds
            if (taken := file.write(data)) != len(data):
                raise OSError(f"its driver took {taken or 0} of {len(data)} bytes")
            # Drivers of adapters say that all is sent when the adapter has it: characters follow.
            termios.tcdrain(port)
            time.sleep(max(0.0, ends - time.monotonic()) + wanted.after)
        except termios.error as error:
            raise OSError(*error.args) from error
        finally:
            _switch(port, on=not wanted.rts_sends)
        return time.monotonic() - ends


def _switch(port: int, *, on: bool) -> None:
    import fcntl
    import termios

    rts = struct.pack("=i", termios.TIOCM_RTS)
    fcntl.ioctl(port, termios.TIOCMBIS if on else termios.TIOCMBIC, rts)
