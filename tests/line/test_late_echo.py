"""An echo that begins later acknowledges no write, although no reply had one before."""

import asyncio

import pytest

from gateway.engine.device.health import State
from gateway.engine.device.reply_shapes import WARY_FOR
from gateway.errors import Unclear
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.tags import WriteResult
from tests.line.slaves import Driver, plant, slave, writable
from tests.sim.bench import Bench
from tests.sim.plant import running
from tests.sim.virtual import on_virtual_time


@pytest.mark.parametrize("driver", [ModbusRtu(station=1), ModbusAscii(station=1)])
@on_virtual_time
async def test_an_echo_that_begins_later_acknowledges_no_write(driver: Driver) -> None:
    """Functions 05 and 06: the device is silent, and only our own request comes back."""
    tags = writable(driver)
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(), echo_in_file=False)
    async with running(line):
        await asyncio.sleep(3600)
        for tag, value in zip(tags, (1234, True), strict=True):
            before = line.now[tag].value
            polled = dev.record.exchanges
            while dev.record.exchanges == polled:
                await asyncio.sleep(0.005)
            line.bench.echo = line.stations[0].mute = True
            done = line.submit(dev, tag, value)
            await asyncio.sleep(5)
            assert isinstance(done.once, Unclear)
            line.bench.echo = line.stations[0].mute = False
            await asyncio.sleep(2 * WARY_FOR)  # the echo was an extra reply
            assert line.now[tag].value == before


@on_virtual_time
async def test_an_echo_is_learned_again_after_an_hour_without() -> None:
    driver = ModbusRtu(station=1)
    tags = writable(driver)
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(), echo_in_file=False)
    async with running(line):
        await asyncio.sleep(3600)
        line.bench.echo = True
        await asyncio.sleep(10)
        for tag, value in zip(tags, (1234, True), strict=True):
            done = line.submit(dev, tag, value)
            await asyncio.sleep(2)
            assert isinstance(done.once, WriteResult)
            assert line.now[tag].value == value
        line.stations[0].mute = True
        lost = line.submit(dev, tags[0], 4321)
        await asyncio.sleep(5)
        assert isinstance(lost.once, Unclear)
        line.stations[0].mute = line.bench.echo = False
        await asyncio.sleep(60)
        assert line.state(dev) is State.ONLINE
        done = line.submit(dev, tags[0], 4321)
        await asyncio.sleep(2)
        assert isinstance(done.once, WriteResult)
