"""The wire of `doors.py`: it outlives each opening of the port, and may be stalled."""

import asyncio
from collections.abc import Sequence
from contextvars import Context, copy_context
from typing import Any

from gateway.planning.wire_timing import WireTiming
from gateway.transport import Receiver
from tests.sim.bench import Bench
from tests.sim.freezer import Ear, Freezer
from tests.sim.virtual import now

NEVER = float("inf")
BETWEEN = 0.3  # seconds between two requests that a stall has held back


class SharedWire:
    """Stations that still answer what the gateway asked before it opened the port again.

    Each opening is a `_Port`. Only the last one hears.
    """

    def __init__(self, bench: Bench, stations: Sequence[Any], wire: WireTiming) -> None:
        self.bench = bench
        self._stations, self._wire = stations, wire
        self._outside: Context = copy_context()
        self._ear: Receiver | None = None
        self._held: list[bytes] | None = None  # requests; None: nothing is held back
        self._replies = b""
        self._stalled_at = -NEVER

    @property
    def stalled_at(self) -> float:
        """The last time when something was held back."""
        return self._stalled_at if self._held is None else now()

    async def open(self, receiver: Receiver, freezer: Freezer) -> "_Port":
        """Raises `LineDown` while it is unplugged. What waited in the system is discarded."""
        if self.bench.inner is None or self.bench.gone:
            await self.bench.open(self._stations, self._wire, self)
        self._ear, self._replies = Ear(freezer, receiver), b""
        return _Port(self, self._ear)

    # The receiver of the bench

    def received(self, data: bytes) -> None:
        if self._held is not None:
            self._replies += data
        elif self._ear is not None:
            self._ear.received(data)

    def lost(self, error: Exception) -> None:
        if self._ear is not None:
            self._ear.lost(error)

    # From the ports

    def write(self, data: bytes) -> None:
        if self._held is None:
            self._outside.run(self.bench.write, data)
        else:
            self._held.append(data)

    def leave(self, ear: Receiver) -> None:
        """Notes that a port was closed: what a stall has held back is lost."""
        if self._ear is ear:
            self._ear, self._replies = None, b""
            if self._held is not None:
                self._held.clear()

    # The device server

    def stall(self) -> None:
        self._held = []

    async def flow(self) -> None:
        """Ends the stall: replies come at once, and requests go on one by one."""
        while self._held:
            replies, self._replies = self._replies, b""
            if replies and self._ear is not None:
                self._ear.received(replies)
            if not self.bench.gone:
                self.bench.write(self._held.pop(0))
            await asyncio.sleep(BETWEEN)
        self._stalled_at = now()
        self._held, replies, self._replies = None, self._replies, b""
        if replies and self._ear is not None:
            self._ear.received(replies)


class _Port:
    def __init__(self, wire: SharedWire, ear: Receiver) -> None:
        self._wire, self._ear = wire, ear

    def write(self, data: bytes) -> None:
        self._wire.write(data)

    async def close(self) -> None:
        self._wire.leave(self._ear)
