"""A station that takes more of the wire than its plan says, and the others on its line."""

import asyncio
import itertools
from dataclasses import replace

from gateway.engine.device.device import Device
from gateway.engine.results.giving_way import LONGEST, SHARE
from gateway.protocols.vigor import Vigor
from tests.sim.plant import Plant, made_device, make_tag, plant, running
from tests.sim.virtual import now, on_virtual_time

EVERY, SLOW = 0.5, 0.8  # seconds: no exchange of the slow station ends before the others are late
MINUTE = 60.0


def line(every: float = EVERY, turnaround: float | None = None) -> Plant:
    """Three stations with one block each, all at one interval. `turnaround`: of the file."""
    devices = []
    for station in (1, 2, 3):
        driver = Vigor(station=station)
        timing = replace(driver.timing, reply_timeout=2.0)
        tags = [make_tag("D0", driver, device=f"d{station}", every=every)]
        devices.append(
            made_device(f"d{station}", driver, plant([]).wire, timing, tags, turnaround=turnaround)
        )
    return plant(devices)


def kept(line: Plant, device: Device, since: float) -> float:
    """Returns the share of its reads."""
    return len(line.reads(device, since)) * device.tags[0].every / (now() - since)


@on_virtual_time
async def test_a_slow_station_costs_the_others_almost_nothing_and_is_read_nevertheless() -> None:
    plant = line()
    slow, *others = plant.devices
    async with running(plant):
        await asyncio.sleep(MINUTE)
        plant.stations[0].late = lambda _: SLOW
        await asyncio.sleep(MINUTE)
        since = now()
        await asyncio.sleep(10 * MINUTE)
        assert all(kept(plant, other, since) > 1 - 2 * SHARE for other in others)
        reads = plant.reads(slow, since)
        assert max(b - a for a, b in itertools.pairwise(reads)) < LONGEST + 2 * SLOW
        assert slow.diagnosed().code == "gives-way"
        assert slow.diagnosis().startswith("A poll takes 0.8")
        assert not any(other.diagnosis() for other in others)
        plant.stations[0].late = lambda _: 0.0
        await asyncio.sleep(LONGEST + 2 * SLOW)
        since = now()
        await asyncio.sleep(MINUTE)
        assert kept(plant, slow, since) > 1 - SHARE
        assert not slow.diagnosis()


@on_virtual_time
async def test_where_the_others_have_time_a_slow_station_is_read_in_time() -> None:
    plant = line(every=2.0)
    async with running(plant):
        await asyncio.sleep(MINUTE)
        plant.stations[0].late = lambda _: SLOW
        await asyncio.sleep(MINUTE)
        since = now()
        await asyncio.sleep(5 * MINUTE)
        assert all(kept(plant, device, since) > 1 - SHARE for device in plant.devices)
        assert not any(device.diagnosis() for device in plant.devices)


@on_virtual_time
async def test_a_turnaround_of_the_file_is_a_part_of_the_plan() -> None:
    plant = line(turnaround=SLOW)
    plant.stations[0].late = lambda _: SLOW
    async with running(plant):
        await asyncio.sleep(MINUTE)
        since = now()
        await asyncio.sleep(5 * MINUTE)
        slow, other, _ = (kept(plant, device, since) for device in plant.devices)
        assert min(slow, other) > 0.2  # the wire is full: each one has its share
        assert not any(device.diagnosis() for device in plant.devices)


@on_virtual_time
async def test_all_stations_are_slow() -> None:
    plant = line()
    for station in plant.stations:
        station.late = lambda _: SLOW
    async with running(plant):
        await asyncio.sleep(MINUTE)
        since = now()
        await asyncio.sleep(5 * MINUTE)
        assert all(0.15 < kept(plant, device, since) < 0.25 for device in plant.devices)
