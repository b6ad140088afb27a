"""One program that has the wire of a line alone: a door with `raw` or `rfc2217`."""

import asyncio
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING

import structlog

from gateway.errors import LineDown
from gateway.line.line import Line
from gateway.parts.doors.com_port import DRAINS, Change, ComPort, Item, Plain, Reply, Speech
from gateway.parts.doors.documents import GuestDocument
from gateway.parts.doors.guest import MOST_WAITING, guest_document
from gateway.parts.doors.settings import RFC2217
from gateway.transport import Port
from gateway.transport.port import Adjustable
from gateway.transport.telnet import PARITIES, Control, Setting
from gateway.transport.terminal import TerminalPort

if TYPE_CHECKING:
    from gateway.parts.doors.open_door import OpenDoor

log = structlog.get_logger("gateway.line")
HAND_OVER = 20.0  # seconds: the line ends its transaction, and closes a port that may be slow
OLD = 1.0  # seconds: a program repeats what it sent so long before it had the wire
LONGEST = 3600.0  # seconds of one session
LOOK_EVERY = 0.1  # seconds between two looks at the modem lines and at the terminal
_MOST_ITEMS = 256  # that wait
# The kinds of `Control` that stay until they are changed: its request, and its values.
_LASTING = ((Control.DTR, Control.DTR_OFF), (Control.RTS, Control.RTS_OFF))


class Tunnel:
    """Passes bytes between the program and the wire, and understands none of them.

    The session ends with the connection, after `idle` seconds without a byte of the program, or
    when an operator releases the line.
    """

    def __init__(self, door: "OpenDoor", line: Line, address: str) -> None:
        self._door = door
        self._line = line
        self._ear = _Ear(self)
        self._address = address
        self._since = asyncio.get_running_loop().time()
        self._speech: Speech = ComPort() if door.settings.protocol == RFC2217 else Plain()
        self._bytes = 0
        self._items = deque[Item]()  # that wait for the wire, or for a change of its settings
        self._waiting = 0  # bytes of them
        self._spoke = asyncio.Event()
        self._program: Port | None = None
        self._wire: Port | None = None
        self._set_up = Settings(door)
        self._work: asyncio.Task[None] | None = None
        self._why = ""

    # The receiver of the connection

    def opened(self, port: Port) -> None:
        self._program = port
        if not self._door.may_write(port):  # with the wire alone it could do everything
            self._door.turn_away(self._address)
            self._door.start(port.close())
            return
        self._door.guests.add(self)
        self._work = self._door.start(self._serve())

    def received(self, data: bytes) -> None:
        if why := self._door.why_not(asyncio.get_running_loop().time()):
            self.leave(why)
            return
        self._follow()
        self._say(self._speech.begin())
        for item in self._speech.hear(data):
            if isinstance(item, Reply):
                self._say(item.data)
                continue
            size = len(item) if isinstance(item, bytes) else 0
            self._waiting += size
            self._bytes += size
            self._items.append(item)
        if self._waiting > MOST_WAITING or len(self._items) > _MOST_ITEMS:
            self.leave("it sent more than the wire carries")
        self._spoke.set()

    def lost(self, _error: Exception) -> None:
        self._program = None
        self.leave()

    def leave(self, why: str = "") -> None:
        """Ends the session. `why`: empty, the program has gone."""
        self._why = self._why or why
        work, self._work = self._work, None
        if work is not None:
            work.cancel()

    def _say(self, data: bytes) -> None:
        self._pass(data, self._program)

    def _pass(self, data: bytes, port: Port | None) -> None:
        try:
            if port is not None and data:
                port.write(data)
        except LineDown as error:
            self.leave(str(error))

    # The session

    async def _serve(self) -> None:
        name, line = self._door.settings.name, self._line
        loop = asyncio.get_running_loop()
        began = loop.time()
        looks = None
        try:
            async with asyncio.timeout(HAND_OVER):
                self._wire = await line.lend(f"{name} ({self._address}) has the wire", self._ear)
            log.warning("wire lent", line=line.name, door=name, address=self._address)
            if loop.time() - self._since > OLD:
                old = [item for item in self._items if isinstance(item, bytes)]
                self._waiting -= sum(map(len, old))
                self._items = deque(item for item in self._items if not isinstance(item, bytes))
            self._say(self._speech.begin())
            looks = self._door.start(self._look())
            async with asyncio.timeout(LONGEST):
                await self._pass_on()
        except (LineDown, TimeoutError) as error:
            self._why = self._why or str(error) or "it was idle, or had it for too long"
        finally:
            if looks is not None:
                looks.cancel()
            await self._end(began)

    async def _pass_on(self) -> None:
        """Passes on what the program wants, in its order. Raises `TimeoutError` when it is idle."""
        while self._wire is not None:
            self._spoke.clear()
            if not self._items:
                async with asyncio.timeout(self._door.settings.idle):
                    await self._spoke.wait()
                continue
            item = self._items.popleft()
            if isinstance(item, bytes):
                self._waiting -= len(item)
                if why := self._door.why_not(asyncio.get_running_loop().time()):
                    raise LineDown(why)
                self._set_up.sent(len(item))
                self._pass(item, self._wire)
            elif isinstance(item, Change):
                value = await self._set_up.change(self._wire, item)
                self._say(self._speech.done(item, value))

    async def _look(self) -> None:
        """Reports modem lines, and follows a terminal that only listens."""
        told = -1
        while True:
            await asyncio.sleep(LOOK_EVERY)
            self._follow()
            if isinstance(self._speech, ComPort) and isinstance(self._wire, Adjustable):
                found = await self._wire.adjust(Setting.MODEM_STATE, 0)
                if found != told:
                    self._say(self._speech.done(Change(Setting.MODEM_STATE, 0), found))
                    told = found

    def _follow(self) -> None:
        """Notes the speed and the stop bits that a program has set at the terminal."""
        if isinstance(self._program, TerminalPort):
            speed, stop_bits = self._program.settings()
            if speed and self._set_up.terminal != (speed, stop_bits):
                self._set_up.terminal = speed, stop_bits
                self._items.append(Change(Setting.BAUDRATE, speed))
                self._items.append(Change(Setting.STOP_BITS, stop_bits))
                self._spoke.set()

    async def _end(self, began: float) -> None:
        now, wire, self._wire = asyncio.get_running_loop().time, self._wire, None
        program, self._program = self._program, None
        self._door.guests.discard(self)
        try:
            if wire is not None:
                with suppress(TimeoutError):
                    async with asyncio.timeout(HAND_OVER):
                        await self._set_up.put_back(wire)
            for port in (wire, program):
                if port is not None:
                    await port.close()
        finally:
            self._line.take_back(self._ear)
            if wire is not None:
                what = (
                    f"it had the wire, and sent {self._bytes} bytes; {self._why or 'it has gone'}"
                )
                by, took = f"door {self._door.settings.name}, {self._address}", now() - began
                self._door.tell(f"lines/{self._line.name}/@wire", by, took, what)

    # The receiver of the wire

    def heard(self, data: bytes) -> None:
        """Passes bytes of the wire on."""
        self._say(self._speech.encode(data))

    def document(self, now: float) -> GuestDocument:
        return guest_document(self._address, now - self._since)


class Settings:
    """The settings of the port during a session. A TCP port has those of the file only."""

    def __init__(self, door: "OpenDoor") -> None:
        serial = door.serial
        data_bits, parity, stop_bits = tuple(serial.format)
        self._now: dict[Setting, int] = {
            Setting.BAUDRATE: serial.baudrate,
            Setting.DATA_BITS: int(data_bits),
            Setting.PARITY: PARITIES[parity],
            Setting.STOP_BITS: int(stop_bits),
        }
        self.terminal = 0, 0  # the speed and the stop bits that a program has set there
        self._free_at = 0.0  # by the loop's clock: all bytes have been sent
        self._lines = dict[int, int]()  # by request: the state before the first change

    def sent(self, size: int) -> None:
        """Notes bytes that the port gets now."""
        now = asyncio.get_running_loop().time()
        took = size * 12 / (self._now[Setting.BAUDRATE] or 1)  # bits, with parity and two stop bits
        self._free_at = max(self._free_at, now) + took

    async def change(self, wire: Port, change: Change) -> int:
        """Changes a setting. Returns what the port has then."""
        setting, value = change
        if setting in DRAINS:
            await asyncio.sleep(self._free_at - asyncio.get_running_loop().time())
        if not isinstance(wire, Adjustable):
            return self._now.get(setting, value)
        for asks, last in _LASTING if setting is Setting.CONTROL else ():
            if asks < value <= last and asks not in self._lines:
                known = await wire.adjust(setting, asks)
                # Many device servers do not tell. An open port has its lines on.
                self._lines[asks] = known if asks < known <= last else asks + 1
        found = await wire.adjust(setting, value)
        if setting in self._now and found:
            self._now[setting] = found
        return found

    async def put_back(self, wire: Port) -> None:
        """Sets the modem lines as they were. The line sets the rest when it opens the port."""
        if isinstance(wire, Adjustable):
            for before in self._lines.values():
                await wire.adjust(Setting.CONTROL, before)


class _Ear:
    """The receiver of the port that the line has lent."""

    def __init__(self, tunnel: Tunnel) -> None:
        self._tunnel = tunnel

    def received(self, data: bytes) -> None:
        self._tunnel.heard(data)

    def lost(self, error: Exception) -> None:
        self._tunnel.leave(str(error))
