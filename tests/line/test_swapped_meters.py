"""Two meters change places on a wire, and no request is missed meanwhile."""

import asyncio
from dataclasses import replace

import pytest

from gateway.protocols.modbus import ModbusRtu
from gateway.stations.modbus import ModbusStation
from gateway.tags import Quality, Reason
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.plant import Plant, made_device, make_tag, running
from tests.sim.virtual import on_virtual_time

SERIAL, ENERGY = "holding:40", "holding:0"
QUESTION = 0.1  # seconds of one, and of what is in flight before it, at most


def meters(every: float) -> Plant:
    """Each has its number as serial number and as energy."""
    devices, stations = [], []
    for number in (1, 2):
        driver = ModbusRtu(station=number)
        tags = [
            make_tag(text, driver, device=f"m{number}", every=every) for text in (ENERGY, SERIAL)
        ]
        identity = {tags[1].name: str(number)}
        timing = replace(driver.timing, reply_timeout=0.5)
        devices.append(made_device(f"m{number}", driver, WIRE, timing, tags, identity=identity))
        station = ModbusStation(station=number)
        stations.append(Unruly(station))  # type: ignore[arg-type]  # any station will do
        for tag in tags:
            station.memory.write(tag.span.area, tag.span.start, [number])
    return Plant(devices, stations, Bench(), WIRE)


@pytest.mark.parametrize("every", [1.0, 2.0, 5.0])
@on_virtual_time
async def test_both_are_bad_within_one_cycle_and_good_again_within_one(every: float) -> None:
    plant = meters(every)
    async with running(plant):
        await asyncio.sleep(60.3)
        assert all(plant.good(device) for device in plant.devices)
        for swapped in (True, False):
            for station in plant.stations:
                station.inner.station = 3 - station.inner.station
            await asyncio.sleep(every + QUESTION)
            for device in plant.devices:
                sample = plant.now[device.tags[0]]
                good = (Quality.GOOD, None)
                wanted = (Quality.BAD, Reason.WRONG_DEVICE) if swapped else good
                assert (sample.quality, sample.reason) == wanted
            await asyncio.sleep(30.0)
