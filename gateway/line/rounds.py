"""Connections that last for one round of polls: `close_after: round`."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from gateway.errors import CallEnded, LineDown
from gateway.transport import Port, Receiver, open_port
from gateway.transport.port import PortAddress, SerialSettings

PAUSES = (0.5, 1.0)  # seconds before the second and third try to connect
LOST = "connection lost"  # the result of a round


@dataclass(slots=True)
class RoundPort:
    """A `CallPort` that is connected during a round only: `write` raises `CallEnded` between."""

    opens: Callable[[Receiver], Awaitable[Port]]
    receiver: Receiver
    delay: float  # seconds from the connection to the first request
    _port: Port | None = field(default=None, init=False)

    async def dial(self) -> None:
        """Returns when a request may be sent. Raises `LineDown` after three tries.

        Another client may have the only connection of the server for a moment.
        """
        for pause in PAUSES:
            try:
                await self._connect()
            except LineDown:
                await asyncio.sleep(pause)
            else:
                return
        await self._connect()

    async def _connect(self) -> None:
        self._port = await self.opens(self)
        await asyncio.sleep(self.delay)

    async def hang_up(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            await port.close()

    close = hang_up

    def write(self, data: bytes) -> None:
        if self._port is None:
            raise CallEnded("not connected between two rounds", LOST)
        self._port.write(data)

    # The receiver of the connection

    def received(self, data: bytes) -> None:
        self.receiver.received(data)

    def lost(self, error: Exception) -> None:
        self.receiver.lost(CallEnded(str(error), LOST))


@dataclass(frozen=True, slots=True)
class ConnectionOpener:
    """Opens the connection of a line with `connect_delay` or `close_after`."""

    where: PortAddress
    serial: SerialSettings
    delay: float
    rounds: bool

    async def __call__(self, receiver: Receiver) -> Port:
        """Connects, to see that somebody is there. Raises `LineDown`."""
        port = await self._open(receiver)
        if self.rounds:
            await port.close()
            return RoundPort(self._open, receiver, self.delay)
        try:
            await asyncio.sleep(self.delay)
        except asyncio.CancelledError:
            await port.close()
            raise
        return port

    def _open(self, receiver: Receiver) -> Awaitable[Port]:
        return open_port(self.where, self.serial, receiver)
