"""Reports the service to its supervisor, systemd: ready, turning, reloading, stopping.

The protocol is that of sd_notify(3): datagrams to the socket that $NOTIFY_SOCKET names. Without the
variable nothing is sent.
"""

import asyncio
import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress

_AGAIN = 0.1  # seconds
_PARTS = 3  # signs of life in the time that systemd waits for one


class Supervisor:
    """Never waits. Reports that the supervisor does not take at once are sent again; signs of life
    are not."""

    def __init__(self, variables: Mapping[str, str] = os.environ) -> None:
        """`variables`: of the environment."""
        self._address = variables.get("NOTIFY_SOCKET", "")
        self._socket: socket.socket | None = None
        own = variables.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._every = int(variables.get("WATCHDOG_USEC", "0")) / 1e6 / _PARTS if own else 0.0
        self._next: asyncio.TimerHandle | None = None

    @contextmanager
    def informed(self) -> Iterator[None]:
        """Sends signs of life while the running event loop turns, and the stop at the end."""
        if not self._address:
            yield
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as opened:
            opened.setblocking(False)
            self._socket = opened
            if self._every:
                self._turn(asyncio.get_running_loop())
            try:
                yield
            finally:
                self._socket = None
                if self._next is not None:
                    self._next.cancel()

    def ready(self) -> None:
        self._report("READY=1")

    def reloading(self) -> None:
        """Reports that the file is read again, until `ready`."""
        self._report(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def says(self, status: str) -> None:
        """Sends one line for people: `systemctl status` shows it."""
        self._report(f"STATUS={status}")

    def stopping(self) -> None:
        self._report("STOPPING=1")

    def _turn(self, loop: asyncio.AbstractEventLoop) -> None:
        with suppress(OSError):  # it is asked for again soon
            self._send("WATCHDOG=1")
        self._next = loop.call_later(self._every, self._turn, loop)

    def _report(self, text: str) -> None:
        try:
            self._send(text)
        except BlockingIOError:
            asyncio.get_running_loop().call_later(_AGAIN, self._report, text)
        except OSError:
            pass  # no supervisor is there any more

    def _send(self, text: str) -> None:
        if self._socket is None:
            return
        # A name that begins with @ is none of the file system.
        address = f"\0{self._address[1:]}" if self._address[0] == "@" else self._address
        self._socket.sendto(text.encode(), address)
