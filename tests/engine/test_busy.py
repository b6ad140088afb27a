"""A device that replies that it is busy is polled again after a pause."""

import asyncio
from dataclasses import dataclass, field, replace

from gateway.engine.device.health import State
from gateway.engine.results.busy_devices import FIRST
from gateway.engine.results.poll_rules import BUSY_PAUSE
from gateway.protocols.checksums import crc16
from gateway.protocols.modbus import ModbusRtu
from gateway.stations.modbus import ModbusStation
from gateway.stations.station import Memory
from gateway.tags import Quality, Reason
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.plant import Plant, made_device, make_tag, running
from tests.sim.virtual import on_virtual_time

READ, BUSY = 3, 6


@dataclass
class BusyStation:
    """A station that replies "busy" to its next `left` reads, and notes their times."""

    inner: ModbusStation
    station: int = 1
    mute: bool = False
    left: int = 0
    asked: list[float] = field(default_factory=list)  # from the first busy reply on

    @property
    def memory(self) -> Memory:
        return self.inner.memory

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if data[1] != READ or not (self.asked or self.left):
            return self.inner.hear(data, now)
        self.asked.append(now)
        if not self.left:
            return self.inner.hear(data, now)
        self.left -= 1
        body = bytes([data[0], READ | 0x80, BUSY])
        return [body + crc16(body)]


def busy_plant() -> tuple[Plant, BusyStation]:
    """Ten registers every 10 s."""
    driver = ModbusRtu(station=1)
    tags = [make_tag(f"holding:{n}", driver, every=10.0) for n in range(10)]
    times = replace(driver.timing, retries=2)
    dev = made_device("plc", driver, WIRE, times, tuple(tags), 0.3)
    station = BusyStation(ModbusStation(station=1))
    unruly = [Unruly(station)]  # type: ignore[arg-type]  # any station will do
    return Plant([dev], unruly, Bench(), WIRE), station


@on_virtual_time
async def test_a_device_busy_twice_is_polled_again_at_growing_pauses_and_keeps_its_values() -> None:
    line, station = busy_plant()
    (dev,) = line.line.engine.devices
    async with running(line):
        await asyncio.sleep(5)
        assert line.good(dev)
        line.reported.clear()
        station.left = 2
        await asyncio.sleep(12)
        first, second, third = station.asked[:3]
        assert BUSY_PAUSE <= second - first < BUSY_PAUSE + 0.1
        assert FIRST <= third - second < FIRST + 0.1
        assert {sample.quality for _, sample in line.reported} == {Quality.GOOD}
        assert dev.state is State.ONLINE
        assert dev.record.refusals == {"06": 2}


@on_virtual_time
async def test_a_device_that_stays_busy_has_bad_values_but_its_block_is_not_halved() -> None:
    line, station = busy_plant()
    (dev,) = line.line.engine.devices
    async with running(line):
        await asyncio.sleep(5)
        station.left = 3
        await asyncio.sleep(9)
        assert len(station.asked) == 3
        assert {line.reason(tag) for tag in dev.tags} == {Reason.REFUSED}
        assert "busy" in line.now[dev.tags[0]].detail
        assert dev.bad_addresses.bad == {}
        assert len(dev.blocks) == 1
        await asyncio.sleep(12)
        assert line.good(dev)
