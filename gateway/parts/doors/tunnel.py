"""One program that has the wire of a line alone: a door with `protocol: raw`."""

import asyncio
import time
from typing import TYPE_CHECKING

import orjson
import structlog

from gateway.contract.documents.requests import OutcomeDocument
from gateway.contract.documents.state import GuestDocument
from gateway.errors import LineDown
from gateway.parts.doors.guest import MOST_WAITING, guest_document
from gateway.tags.timestamps import rfc3339
from gateway.transport import Port

if TYPE_CHECKING:
    from gateway.parts.doors.open_door import OpenDoor

log = structlog.get_logger("gateway.line")
HAND_OVER = 20.0  # seconds: the line ends its transaction, and closes a port that may be slow
OLD = 1.0  # seconds: a program repeats what it sent so long before it had the wire
LONGEST = 3600.0  # seconds of one session


class Tunnel:
    """Passes bytes between the program and the wire, and understands none of them.

    The session ends with the connection, or after `idle` seconds without a byte of the program.
    """

    def __init__(self, door: "OpenDoor", address: str) -> None:
        self._door = door
        self._line = door.line
        self._address = address
        self._since = asyncio.get_running_loop().time()
        self._bytes = 0
        self._waiting = bytearray()  # before the port is there
        self._program: Port | None = None
        self._wire: Port | None = None
        self._spoke = asyncio.Event()
        self._work: asyncio.Task[None] | None = None

    # The receiver of the connection

    def opened(self, port: Port) -> None:
        self._program = port
        self._door.guests.add(self)
        self._work = self._door.start(self._serve())

    def received(self, data: bytes) -> None:
        self._bytes += len(data)
        self._spoke.set()
        if self._wire is not None:
            self._pass(data, self._wire)
        elif len(self._waiting) + len(data) > MOST_WAITING:
            self.leave()
        else:
            self._waiting += data

    def lost(self, _error: Exception) -> None:
        self._program = None
        self.leave()

    def leave(self) -> None:
        """Ends the session."""
        if self._work is not None:
            self._work.cancel()

    def _pass(self, data: bytes, port: Port | None) -> None:
        try:
            if port is not None:
                port.write(data)
        except LineDown:
            self.leave()

    # The session

    async def _serve(self) -> None:
        name, line = self._door.settings.name, self._line
        began = time.monotonic()
        try:
            async with asyncio.timeout(HAND_OVER):
                self._wire = await line.lend(f"{name} ({self._address}) has the wire", _Ear(self))
            log.warning("wire lent", line=line.name, door=name, address=self._address)
            if asyncio.get_running_loop().time() - self._since < OLD:
                self._pass(bytes(self._waiting), self._wire)
            self._waiting.clear()
            async with asyncio.timeout(LONGEST):
                while True:
                    self._spoke.clear()
                    async with asyncio.timeout(self._door.settings.idle):
                        await self._spoke.wait()
        except (LineDown, TimeoutError) as error:
            log.info("wire session ended", line=line.name, door=name, why=str(error) or "idle")
        finally:
            await self._end(began)

    async def _end(self, began: float) -> None:
        wire, self._wire = self._wire, None
        program, self._program = self._program, None
        self._door.guests.discard(self)
        try:
            for port in (wire, program):
                if port is not None:
                    await port.close()
        finally:
            self._line.take_back()
            if wire is not None:
                self._tell(time.monotonic() - began)

    def _tell(self, took: float) -> None:
        """Has the audit keep the session."""
        line, name, now = self._line.name, self._door.settings.name, time.time_ns()
        log.warning("wire returned", line=line, door=name, address=self._address, took=round(took))
        event: OutcomeDocument = {
            "key": f"lines/{line}/@wire",
            "value": None,
            "time": rfc3339(now),
            "took": round(took, 3),
            "by": f"door {name}, {self._address}",
            "outcome": "obeyed",
            "answer": f"it had the wire, and sent {self._bytes} bytes",
        }
        self._door.audit(now, orjson.dumps(event).decode())

    # The receiver of the wire

    def heard(self, data: bytes) -> None:
        """Passes bytes of the wire on."""
        self._pass(data, self._program)

    def document(self, now: float) -> GuestDocument:
        return guest_document(self._address, now - self._since)


class _Ear:
    """The receiver of the port that the line has lent."""

    def __init__(self, tunnel: Tunnel) -> None:
        self._tunnel = tunnel

    def received(self, data: bytes) -> None:
        self._tunnel.heard(data)

    def lost(self, _error: Exception) -> None:
        self._tunnel.leave()
