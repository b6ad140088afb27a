"""A served line and its port: when each master is silent, and how the port is opened again."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gateway.config import built
from gateway.errors import LineDown
from gateway.parts.serving.part import served_documents
from gateway.parts.serving.served_line import ServedLine
from gateway.stations.served.station import ServedStation
from gateway.tags import Sample
from gateway.transport import Port, Receiver
from tests.line.telephone import now, running
from tests.sim.virtual import on_virtual_time


class Wire:
    """A port on which nothing is said."""

    def __init__(self, receiver: Receiver) -> None:
        self.receiver = receiver
        self.is_open = True

    def write(self, data: bytes) -> None:
        raise AssertionError(f"{data!r} is no reply to a request")

    async def close(self) -> None:
        self.is_open = False


class Hall:
    """Two stations on one wire, and what becomes of their values."""

    def __init__(self) -> None:
        devices = {
            f"plc-{number}": {
                "protocol": "vigor",
                "station": number,
                "stale_after": stale_after,
                "accept": ["D0"],
                "tags": {"level": {"address": "D0"}},
            }
            for number, stale_after in ((1, "1h"), (2, "10s"))
        }
        line = {"port": "/dev/ttyS98", "serve": True, "devices": devices}
        [config] = built({"lines": {"hall": line}}, Path()).lines
        self.ports: list[Wire] = []
        self.bad: list[str] = []
        self.line = ServedLine(config, self, lambda row: None, open_port=self._open)

    async def _open(self, receiver: Receiver) -> Port:
        self.ports.append(Wire(receiver))
        return self.ports[-1]

    # The sample sink

    def samples(self, samples: Sequence[Sample]) -> None:
        self.bad += [sample.tag.key for sample in samples]

    def online(self, device: ServedStation, online: bool) -> None:
        raise AssertionError(f"{device.name} has no master")


@on_virtual_time
async def test_each_master_is_silent_after_its_own_time() -> None:
    async with running(Hall()) as hall:
        await asyncio.sleep(9.9)
        assert hall.bad == []
        await asyncio.sleep(0.2)
        assert hall.bad == ["plc-2/level"]
        await asyncio.sleep(3600)
        assert hall.bad == ["plc-2/level", "plc-1/level"]


@on_virtual_time
async def test_a_port_that_worked_is_closed_and_opened_again_at_once() -> None:
    async with running(Hall()) as hall:
        for _ in range(8):
            await asyncio.sleep(60)
            hall.ports[-1].receiver.lost(LineDown("unplugged"))
            await asyncio.sleep(0.5)
            assert hall.line.is_open
        assert [port.is_open for port in hall.ports] == [False] * 8 + [True]
        documents: Any = served_documents([hall.line], now())
        assert documents["lines/hall"]["open_for"] <= 0.5
