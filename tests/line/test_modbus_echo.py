"""Modbus behind an adapter that echoes: no echo acknowledges a write or completes a probe."""

import asyncio

import pytest
from structlog.testing import capture_logs

from gateway.engine.device.health import State
from gateway.errors import Evidence, Unclear
from gateway.protocols.modbus import (
    ModbusAscii,
    ModbusRtu,
)
from gateway.tags import WriteResult, WriteRule
from tests.line.slaves import Driver, plant, slave, writable
from tests.sim.bench import Bench
from tests.sim.plant import make_tag, running
from tests.sim.virtual import on_virtual_time


@on_virtual_time
async def test_with_echo_in_the_file_an_echo_is_no_acknowledgement() -> None:
    """The normal reply to functions 05 and 06 is the request itself."""
    driver = ModbusRtu(station=1)
    tags = [
        make_tag("holding:5", driver, type="uint16", write=WriteRule()),
        make_tag("coil:5", driver, write=WriteRule()),
    ]
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(echo=True))
    async with running(line):
        await asyncio.sleep(5)
        for tag, value in ((tags[0], 1234), (tags[1], True)):
            done = line.submit(dev, tag, value)
            await asyncio.sleep(0.5)
            assert isinstance(done.once, WriteResult)
        assert not dev.record.failures
        for tag, value in ((tags[0], 4321), (tags[1], False)):
            line.stations[0].mute = True
            lost = line.submit(dev, tag, value)
            await asyncio.sleep(1.5)
            assert isinstance(lost.once, Unclear)
            line.stations[0].mute = False
            await asyncio.sleep(70)
        assert dev.record.failures[Evidence.SILENCE] >= 2
        assert [line.now[tag].value for tag in tags] == [1234, True]  # a mute slave writes nothing


@pytest.mark.parametrize("driver", [ModbusRtu(station=1), ModbusAscii(station=1)])
@on_virtual_time
async def test_without_echo_in_the_file_an_echo_is_no_acknowledgement(driver: Driver) -> None:
    tags = writable(driver)
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(echo=True), echo_in_file=False)
    async with running(line):
        await asyncio.sleep(5)
        for tag, value in zip(tags, (1234, True), strict=True):
            done = line.submit(dev, tag, value)
            await asyncio.sleep(0.9)
            assert isinstance(done.once, WriteResult)
            assert line.now[tag].value == value
        for tag, value in zip(tags, (4321, False), strict=True):
            line.stations[0].mute = True
            lost = line.submit(dev, tag, value)
            await asyncio.sleep(1.5)
            assert isinstance(lost.once, Unclear)
            line.stations[0].mute = False
            await asyncio.sleep(70)
        assert [line.now[tag].value for tag in tags] == [1234, True]


@on_virtual_time
async def test_without_echo_in_the_file_an_echo_is_logged_once() -> None:
    driver = ModbusRtu(station=1)
    line = plant([slave(driver, writable(driver))], bench=Bench(echo=True), echo_in_file=False)
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(60)
            line.bench.vanish()
            await asyncio.sleep(5)
            line.bench.come_back()
            await asyncio.sleep(60)
    logged = [entry for entry in logs if "adapter echoes" in entry["event"]]
    assert [(entry["event"], entry["log_level"]) for entry in logged] == [
        ("adapter echoes", "warning")
    ]


@on_virtual_time
async def test_without_an_echo_a_write_takes_one_transaction() -> None:
    driver = ModbusRtu(station=1)
    tags = writable(driver)
    dev = slave(driver, tags, reply_timeout=2.0)
    line = plant([dev])
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(5)
            for tag, value in zip(tags, (1234, True), strict=True):
                done = line.submit(dev, tag, value)
                await asyncio.sleep(0.5)
                assert isinstance(done.once, WriteResult)
            assert not dev.record.failures
    assert not [entry for entry in logs if "echo" in entry["event"]]


@on_virtual_time
async def test_an_echoed_loopback_does_not_bring_a_mute_slave_online() -> None:
    """The reply to function 08 is the request, too."""
    driver = ModbusRtu(station=1, diagnostics=True)
    dev = slave(driver, writable(driver))
    line = plant([dev], bench=Bench(echo=True), echo_in_file=False)
    line.stations[0].mute = True
    async with running(line):
        await asyncio.sleep(60)
        assert line.state(dev) is State.OFFLINE
        assert not any(online for _, _, online in line.online_changes)
        line.stations[0].mute = False
        await asyncio.sleep(70)
        assert line.state(dev) is State.ONLINE
