"""Noise on the wire: a device whose replies are spoiled is asked again soon, for it is alive."""

import asyncio
import random
from typing import Any

import pytest

from benchmarks.noise import PROTOCOLS, measure
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.protocols.modbus import ModbusRtu
from tests.line.slaves import plant, registers, slave
from tests.sim.plant import Plant, running
from tests.sim.virtual import on_virtual_time

EVERY = 0.02  # seconds
SECONDS = 60


def noisy(line: Plant, number: int, spoiled: float, lost: float) -> None:
    """Spoils and loses replies of a station, by chance."""
    station, chance = line.stations[number], random.Random(number)
    inner = station.answer or station.inner.hear

    def answer(data: bytes, now: float) -> list[bytes]:
        replies, luck = inner(data, now), chance.random()
        if luck < lost:
            return []
        if luck < lost + spoiled:
            return [bytes([*reply[:-1], reply[-1] ^ 0x10]) for reply in replies]
        return replies

    station.answer = answer


async def reads(line: Plant, device: Device) -> float:
    """Good reads a second."""
    await asyncio.sleep(5)
    before = device.record.exchanges
    await asyncio.sleep(SECONDS)
    return (device.record.exchanges - before) / SECONDS


async def measured(others: int, spoiled: float, lost: float) -> float:
    drivers = [ModbusRtu(station=n) for n in range(1, others + 2)]
    devices = [slave(d, registers(d, 3, every=EVERY if d.station == 1 else 1.0)) for d in drivers]
    line: Any = plant(devices)
    noisy(line, 0, spoiled, lost)
    async with running(line):
        return await reads(line, devices[0])


@pytest.mark.parametrize(
    ("others", "spoiled", "least"),
    [(0, 0.1, 0.53), (0, 0.2, 0.25), (0, 0.4, 0.07)],
)
@on_virtual_time
async def test_a_noisy_device_keeps_a_share_of_its_polls(
    others: int, spoiled: float, least: float
) -> None:
    """Of 50 polls a second; fewer before damaged replies were a sign of life."""
    assert await measured(others, spoiled, 0.0) >= least * 49


@pytest.mark.parametrize("healthy", [0, 8])
@pytest.mark.parametrize("protocol", PROTOCOLS)
@on_virtual_time
async def test_a_noisy_wire_gives_most_of_what_it_could_carry(protocol: str, healthy: int) -> None:
    """5 % of its replies are lost, and 20 % have one wrong bit anywhere."""
    _, _, share, _, wrong = await measure(protocol, 0.25, healthy, 300.0)
    assert (float(share) >= 0.6, wrong) == (True, "0")


@on_virtual_time
async def test_a_device_that_is_slow_when_it_returns_is_seen_at_once() -> None:
    """It replied after 5 ms, and after 250 ms when it is back: later than a short probe waits."""
    drivers = [ModbusRtu(station=n) for n in (1, 2)]
    devices = [slave(d, registers(d, 3, every=0.5)) for d in drivers]
    line: Any = plant(devices)
    async with running(line):
        await asyncio.sleep(30)
        line.stations[0].mute = True
        await asyncio.sleep(15)
        assert line.state(devices[0]) is State.OFFLINE
        line.stations[0].late = lambda _: 0.25
        line.stations[0].mute = False
        await asyncio.sleep(8)
        assert line.good(devices[0])
