"""A device server between line and PLC, which may stall."""

import asyncio
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from gateway.tags import Tag
from gateway.transport import Receiver
from tests.sim.bench import WIRE, Bench
from tests.sim.plant import Plant, made_device
from tests.sim.virtual import now

# Those whose replies have no number
DRIVERS = [
    ModbusRtu(station=1),
    ModbusAscii(station=1),
    Vigor(station=1),
    ComputerLink(station=1, monitor=False),
]
by_protocol = pytest.mark.parametrize("driver", DRIVERS, ids=lambda driver: driver.protocol)
GUARD = 0.5
TURNAROUND = 0.005  # seconds of its PLC


@dataclass
class DeviceServer(Bench):
    """Passes requests to the PLC one by one, each after the reply to the one before.

    While it is stalled it keeps them and loses none, as TCP does.
    """

    late: Callable[[random.Random], float] = lambda _: 0.0  # seconds on top, for each reply
    deaf_to: Callable[[bytes], bool] = lambda _: False  # requests that are lost on the wire
    latency: float = 0.0  # seconds, of what comes back
    flows: asyncio.Event = field(default_factory=asyncio.Event)
    _queue: "asyncio.Queue[bytes]" = field(default_factory=asyncio.Queue)
    _task: "asyncio.Task[None] | None" = None

    async def open(
        self, stations: Sequence[Any], wire: WireTiming, ear: Receiver
    ) -> "DeviceServer":
        self.ear, (self._station,) = ear, stations
        self.flows.set()
        self._task = asyncio.create_task(self._serve())
        return self

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        self._queue.put_nowait(data)

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def received(self, data: bytes) -> None:
        if self.ear is not None:
            loop, receive = asyncio.get_running_loop(), self.ear.received
            if self.latency:
                loop.call_later(self.latency, receive, data)
            else:
                loop.call_soon(receive, data)

    async def _serve(self) -> None:
        while True:
            request = await self._queue.get()
            await self.flows.wait()
            arrives = len(request) * WIRE.character
            if self.echo:
                await asyncio.sleep(arrives)
                self.received(request)
                arrives = 0.0
            await asyncio.sleep(arrives + TURNAROUND)
            answers = [] if self.deaf_to(request) else self._station.hear(request, now())
            for answer in answers:
                await asyncio.sleep(len(answer) * WIRE.character + self.late(self._random))
                self.received(answer)


def behind(
    server: DeviceServer,
    driver: AnyDriver,
    *tags: Tag,
    echo_in_file: bool = True,
    inherits: bool = False,
    **timing: Any,
) -> tuple[Plant, Device, Any]:
    """The line, its device, and the memory of its PLC."""
    dev = made_device("plc", driver, WIRE, replace(driver.timing, **timing), tags, GUARD)
    station = station_for(driver, [])
    stations: Any = [station]
    line = Plant([dev], stations, server, WIRE, echo_in_file=echo_in_file, inherits=inherits)
    return line, dev, station.memory
