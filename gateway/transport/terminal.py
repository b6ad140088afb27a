"""A pseudo terminal with a name that stays, which other programs open as a serial port."""

import asyncio
import errno
import grp
import os
import select
import socket
import termios
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import structlog

from gateway.errors import LineDown
from gateway.transport.listen import Connected
from gateway.transport.os_errors import line_down
from gateway.transport.port import SerialPath

log = structlog.get_logger("gateway.line")
ADDRESS = "terminal"  # of each program, in the place of an IP address
LOOK_EVERY = 0.05  # seconds: Linux does not tell that a program opens a terminal
_LOOKS_AT_LINK = 100  # looks between two looks at the link
_GROUP = "dialout"  # it may use serial ports
_MOST_READ = 4096  # bytes
# The speed before a program sets one. A change of nothing but data bits or parity, which a pseudo
# terminal has not, is an error on some systems; with this speed each program changes something.
_UNSET = termios.B50
RATES = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name[0] == "B" and name[1:].isdigit() and name != "B0"  # which hangs up
}
# With EXTPROC (Linux) the kernel echoes nothing, whatever a program sets: the echo of a reply would
# be taken for its next request.
_EXTPROC = 0o200000
_SENTENCES = {
    errno.EEXIST: "is there already, and is no link to a terminal: remove it",
    errno.ENOENT: "its folder does not exist",
    errno.EADDRINUSE: "another gateway has this terminal",
}


def put_link(path: Path, terminal: str) -> None:
    """Makes a link to the terminal. It replaces a link to another terminal, which a killed process
    has left, and nothing else. Raises `OSError`."""
    if path.is_symlink() and path.readlink().parent == Path(terminal).parent:
        beside = path.with_name(f".{path.name}.new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(terminal)
        beside.replace(path)
    else:
        path.symlink_to(terminal)


def take_link(path: Path, terminal: str) -> None:
    """Removes the link, unless another program has replaced it."""
    with suppress(OSError):
        if path.readlink() == Path(terminal):
            path.unlink()


class Terminal:
    """The terminal for one program after another. As `Listener`.

    A program that is disconnected finds that its port is gone, as if it were unplugged. The next
    terminal has the same name.
    """

    def __init__(self, where: SerialPath) -> None:
        self._path = Path(where.path)
        self._lock: socket.socket | None = None
        self._master = -1
        self._name = ""

    async def open(self) -> None:
        """Raises `LineDown`."""
        try:
            self._lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._lock.bind(f"\0plc-gateway {self._path}")  # free again when this process ends
            await asyncio.to_thread(self._make)
        except (OSError, termios.error) as error:
            raise line_down(str(self._path), error, _SENTENCES) from error

    def _make(self) -> None:
        master, slave = os.openpty()
        try:
            name = os.ttyname(slave)
            _reset(slave)
            with suppress(KeyError, PermissionError):  # then only the user of the gateway may
                os.chown(name, -1, grp.getgrnam(_GROUP).gr_gid)
                Path(name).chmod(0o660)
            os.set_blocking(master, False)
            put_link(self._path, name)
        except OSError:
            os.close(master)
            raise
        finally:
            os.close(slave)  # no program has it now, and `_opened` waits for one
        self._master, self._name = master, name

    async def serve(self, connect: Callable[[str], Connected | None]) -> None:
        """Serves programs until cancelled. `connect` makes the receiver of each; None: it is
        disconnected at once. Raises `LineDown`."""
        loop = asyncio.get_running_loop()
        while True:
            data = await self._opened()
            receiver, hung_up = connect(ADDRESS), True
            if receiver is not None:
                port = TerminalPort(str(self._path), self._master, receiver)
                receiver.opened(port)
                if data:
                    receiver.received(data)
                loop.add_reader(self._master, port.readable)
                try:
                    hung_up = await port.ended
                finally:
                    loop.remove_reader(self._master)
            try:
                if hung_up:
                    self._drop()
                    await asyncio.to_thread(self._make)
                else:
                    await asyncio.to_thread(self._clear)
            except (OSError, termios.error) as error:
                raise line_down(str(self._path), error, _SENTENCES) from error

    async def _opened(self) -> bytes:
        """Waits until a program opens the terminal. Returns what it has sent. Raises `LineDown`."""
        looks = 0
        while True:
            try:
                return os.read(self._master, _MOST_READ)
            except BlockingIOError:
                return b""
            except OSError:  # no program has it open
                looks += 1
            if looks % _LOOKS_AT_LINK == 0 and not await asyncio.to_thread(self._is_linked):
                raise LineDown(f"{self._path}: another program has removed or replaced the link")
            await asyncio.sleep(LOOK_EVERY)

    def _is_linked(self) -> bool:
        with suppress(OSError):
            return self._path.readlink() == Path(self._name)
        return False

    def _clear(self) -> None:
        """Forgets what the last program has set and not read, unless the next one is there."""
        slave = os.open(self._name, os.O_RDWR | os.O_NOCTTY)
        try:
            before = termios.tcgetattr(slave)
            _reset(slave)
            termios.tcflush(slave, termios.TCIFLUSH)
        finally:
            os.close(slave)
        looking = select.poll()
        looking.register(self._master, 0)
        if not looking.poll(0):  # it is not hung up: a program has it open
            termios.tcsetattr(self._master, termios.TCSANOW, before)

    def _drop(self) -> None:
        master, self._master = self._master, -1
        if master >= 0:
            os.close(master)

    async def close(self) -> None:
        """Removes the link and the terminal; never raises."""
        self._drop()
        take_link(self._path, self._name)
        if self._lock is not None:
            self._lock.close()
            self._lock = None


class TerminalPort:
    """One program that has the terminal open; the port of its receiver."""

    def __init__(self, name: str, master: int, receiver: Connected) -> None:
        self._name = name
        self._master = master
        self._receiver = receiver
        # True: this side hangs up. False: the program has closed it.
        self.ended: asyncio.Future[bool] = asyncio.get_running_loop().create_future()

    def settings(self) -> tuple[int, int]:
        """Returns the baud rate, 0 if it is not known, and the stop bits that the program has set.
        Linux keeps neither data bits nor parity of a pseudo terminal."""
        if self.ended.done():
            return 0, 1
        _, _, flags, _, _, speed, _ = termios.tcgetattr(self._master)
        rate = 0 if speed == _UNSET else RATES.get(speed, 0)
        return rate, 2 if flags & termios.CSTOPB else 1

    def readable(self) -> None:
        """Passes bytes of the program on."""
        if self.ended.done():
            return
        try:
            data = os.read(self._master, _MOST_READ)
        except BlockingIOError:
            return
        except OSError:
            mode = termios.tcgetattr(self._master)
            mode[0] |= termios.IXANY  # nothing without IXON: the next program changes it, at least
            termios.tcsetattr(self._master, termios.TCSANOW, mode)
            self._end(hung_up=False)
            self._receiver.lost(LineDown(f"{self._name}: the program has closed it"))
            return
        self._receiver.received(data)

    def _end(self, *, hung_up: bool) -> None:
        if not self.ended.done():
            self.ended.set_result(hung_up)

    def write(self, data: bytes) -> None:
        written = 0
        if not self.ended.done():
            with suppress(OSError):  # it is full
                written = os.write(self._master, data)
        if written < len(data):
            self._end(hung_up=True)
            raise LineDown(f"{self._name}: the program does not read")

    async def close(self) -> None:
        self._end(hung_up=True)


def _reset(slave: int) -> None:
    """Lets all bytes pass as they are, without echo."""
    tty.setraw(slave)
    mode = termios.tcgetattr(slave)
    mode[3] |= _EXTPROC
    mode[4] = mode[5] = _UNSET
    termios.tcsetattr(slave, termios.TCSANOW, mode)
