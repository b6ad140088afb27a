"""A device that is silent about one address loses this tag alone."""

import asyncio
from typing import Any

import pytest

from gateway.config import LineConfig, built
from gateway.plant.plant import Plant
from gateway.tags import Quality
from tests.line.slaves import station_of
from tests.sim.bench import Bench
from tests.sim.virtual import now, on_virtual_time

NUMBERS = (100, 200, 300, 400, 500)
SILENT = 300


class Partly:
    """A slave that says nothing about one register."""

    def __init__(self, inner: Any, framing: str) -> None:
        self.inner = inner
        self.framing = framing
        self.delay = 0.0

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if self._meant(data):
            return []
        replies: list[bytes] = self.inner.hear(data, at)
        return replies

    def _meant(self, data: bytes) -> bool:
        match self.framing:
            case "modbus-rtu":
                pdu = data[1:-2]
            case "modbus-ascii":
                pdu = bytes.fromhex(data[1:-4].decode())[1:]
            case _:
                pdu = data[7:]
        start, count = int.from_bytes(pdu[1:3]), int.from_bytes(pdu[3:5])
        return pdu[0] == 3 and start <= SILENT < start + count


def plant_of(protocol: str) -> Plant:
    tags = {f"t{n}": {"address": f"holding:{n}", "every": "1s"} for n in NUMBERS}
    device = {"protocol": protocol, "station": 1, "tags": tags}
    port = "tcp://127.0.0.1:1502" if protocol == "modbus-tcp" else "tcp://127.0.0.1:4001"
    data = {"lines": {"hall": {"port": port, "baudrate": 19200, "devices": {"meter": device}}}}
    config = built(data)

    def opener(line: LineConfig) -> Any:
        [settings] = line.devices
        driver: Any = settings.driver  # one of the three of Modbus
        station = Partly(station_of(driver), protocol)
        bench = Bench()
        return lambda receiver: bench.open([station], line.wire, receiver)

    return Plant(config, lambda: int(now() * 1e9), opener)


@pytest.mark.parametrize("protocol", ["modbus-rtu", "modbus-ascii", "modbus-tcp"])
@on_virtual_time
async def test_one_silent_register_costs_its_tag_alone(protocol: str) -> None:
    plant = plant_of(protocol)
    [line] = plant.lines
    task = asyncio.create_task(line.run())
    await asyncio.sleep(30)
    good = dict.fromkeys(NUMBERS, 0)
    for _ in range(120):
        await asyncio.sleep(1)
        for n in NUMBERS:
            tag = plant.tag(f"meter/t{n}")
            assert tag is not None
            good[n] += plant.sample(tag).quality is Quality.GOOD
    task.cancel()
    assert good.pop(SILENT) == 0
    assert min(good.values()) >= 115, good
