"""A station that takes more of the wire than its plan says, and the others on its line."""

import asyncio
import itertools
from dataclasses import replace

import pytest

from gateway.engine.device.device import Device
from gateway.engine.results.giving_way import LONGEST, SHARE, GivingWay
from gateway.errors import Evidence, Garbled
from gateway.protocols.vigor import Vigor
from tests.engine.rig import REPLIED, Rig, link_device
from tests.sim.plant import Plant, made_device, make_tag, plant, running
from tests.sim.virtual import now, on_virtual_time

SPOILT = Garbled("wrong sum", evidence=Evidence.CHECKSUM)
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
async def test_a_station_that_was_never_quicker_has_its_share() -> None:
    plant = line()
    plant.stations[0].late = lambda _: SLOW
    async with running(plant):
        await asyncio.sleep(2 * MINUTE)
        since = now()
        await asyncio.sleep(5 * MINUTE)
        assert min(kept(plant, device, since) for device in plant.devices) > 0.2
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


@on_virtual_time
async def test_on_a_line_that_is_asked_for_too_much_a_slow_station_has_its_share() -> None:
    plant = line(every=0.04)
    assert sum(device.load for device in plant.devices) > 1.0
    plant.stations[0].late = lambda _: SLOW
    async with running(plant):
        await asyncio.sleep(MINUTE)
        since = now()
        await asyncio.sleep(5 * MINUTE)
        slow = len(plant.reads(plant.devices[0], since))
        assert slow * SLOW > 0.3 * 5 * MINUTE  # by seconds of the wire, not by reads
        assert not any(device.diagnosis() for device in plant.devices)


@on_virtual_time
async def test_what_a_client_asks_for_does_not_wait() -> None:
    plant = line(every=0.2)
    slow = plant.devices[0]
    async with running(plant):
        await asyncio.sleep(MINUTE)
        plant.stations[0].late = lambda _: SLOW
        await asyncio.sleep(MINUTE)
        assert len(plant.reads(slow, now() - MINUTE / 2)) < 3
        for _ in range(10):
            await asyncio.sleep(1.0)
            asked = now()
            plant.line.expedite(slow, slow.tags[0])
            await asyncio.sleep(3 * SLOW)
            assert plant.reads(slow, asked)


@on_virtual_time
async def test_a_flooding_station_costs_the_others_no_exchange_and_is_read_when_it_ends() -> None:
    """Its second reply is behind junk, where the next request would be."""
    plant = line(every=1.0)
    flooding, *others = plant.devices
    station = plant.stations[0]

    def flood(data: bytes, at: float) -> list[bytes]:
        replies = station.inner.hear(data, at)
        return [*replies, b"?" * 40, *replies] if replies else []

    async with running(plant):
        await asyncio.sleep(MINUTE)
        station.answer = flood
        await asyncio.sleep(2 * MINUTE)
        failed = [sum(other.record.failures.values()) for other in others]
        since = now()
        await asyncio.sleep(10 * MINUTE)
        assert all(kept(plant, other, since) > 1 - 2 * SHARE for other in others)
        assert failed == [sum(other.record.failures.values()) for other in others]
        assert flooding.diagnosed().code == "answers-twice"
        station.answer = None
        await asyncio.sleep(LONGEST + 10.0)
        since = now()
        await asyncio.sleep(MINUTE)
        assert kept(plant, flooding, since) > 1 - SHARE


@pytest.mark.parametrize(("good", "waits"), [(4, False), (20, True)])
def test_a_device_with_some_good_values_is_a_victim_of_noise(good: int, waits: bool) -> None:
    """One of so many polls is good."""
    rig = Rig(link_device(), link_device(station=2))
    (rule,) = (one for one in rig.engine.rules.all if isinstance(one, GivingWay))
    rig.device.health.answered(resynced=True)
    (entry,) = rig.engine.schedule.polls(rig.device)
    for poll in range(200):
        at = float(poll)
        if poll % good:
            rule.concluded(entry.job, SPOILT, REPLIED, at, 0)
        else:
            rule.concluded(entry.job, [0], REPLIED, at, 0)
            rig.engine.schedule.read(entry, [0] * entry.block.span.size, at, 0)
        rig.devices[1].health.answered(resynced=True)
    assert bool(rule.takes(rig.device, 200.0)) is waits
    assert (rule.free(rig.device, 200.0) > 200.0) is waits
    assert not rig.device.turnaround.gives_way  # it is not slow
    rig.device.health.gave_up(200.0, 1.0)
    rule.concluded(entry.job, SPOILT, REPLIED, 200.0, 0)
    assert not rule.takes(rig.device, 200.0)  # its probes have their own share
