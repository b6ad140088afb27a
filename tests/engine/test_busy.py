"""A device that says it is busy is left alone for a while, and asked again."""

import asyncio
from dataclasses import replace

from gateway.engine.health import State
from gateway.engine.results import BUSY_PAUSE
from gateway.protocols.modbus import ModbusRtu
from gateway.stations.modbus import ModbusStation
from gateway.tags import Quality, Reason
from tests.sim.plant import WIRE, Bench, Plant, Unruly, made_device, make_tag, running
from tests.sim.virtual import on_virtual_time

READ, BUSY = 3, 6


class _Patched(ModbusStation):
    """Without slots, so that its answers can be changed."""


def busy_plant() -> tuple[Plant, list[float], list[int]]:
    """Ten registers every 10 s, when they were asked for, and how often it is still busy."""
    driver = ModbusRtu(station=1)
    tags = [make_tag(f"holding:{n}", driver, every=10.0) for n in range(10)]
    times = replace(driver.timing, retries=2)
    dev = made_device("plc", driver, WIRE, times, tuple(tags), 0.3)
    station = _Patched(station=1)
    serve, asked, left = station._serve, list[float](), [0]

    def sometimes(pdu: bytes, now: float) -> bytes:
        if pdu[0] != READ or not (asked or left[0]):
            return serve(pdu, now)
        asked.append(now)
        if left[0]:
            left[0] -= 1
            return bytes([pdu[0] | 0x80, BUSY])
        return serve(pdu, now)

    station._serve = sometimes  # type: ignore[method-assign]
    unruly = [Unruly(station)]  # type: ignore[arg-type]
    return Plant([dev], unruly, Bench(), WIRE), asked, left


@on_virtual_time
async def test_busy_twice_is_asked_again_at_growing_pauses_and_no_value_turns_bad() -> None:
    line, asked, left = busy_plant()
    (dev,) = line.engine.devices
    async with running(line):
        await asyncio.sleep(5)
        assert line.good(dev)
        line.told.clear()
        left[0] = 2
        await asyncio.sleep(12)
        first, second, third = asked[:3]
        assert BUSY_PAUSE <= second - first < BUSY_PAUSE + 0.1
        assert 2 * BUSY_PAUSE <= third - second < 2 * BUSY_PAUSE + 0.1
        assert {sample.quality for _, sample in line.told} == {Quality.GOOD}
        assert dev.state is State.ONLINE
        assert dev.record.refusals == {"06": 2}


@on_virtual_time
async def test_a_device_that_stays_busy_has_bad_values_but_is_not_taken_apart() -> None:
    line, asked, left = busy_plant()
    (dev,) = line.engine.devices
    async with running(line):
        await asyncio.sleep(5)
        left[0] = 3
        await asyncio.sleep(9)
        assert len(asked) == 3
        assert {line.reason(tag) for tag in dev.tags} == {Reason.REFUSED}
        assert "busy" in line.now[dev.tags[0]].detail
        assert dev.bad_addresses.bad == {}
        assert len(dev.blocks) == 1
        await asyncio.sleep(12)
        assert line.good(dev)
