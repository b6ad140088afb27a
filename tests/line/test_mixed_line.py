"""Computer Link PLCs of both formats and a Vigor on one line; unsolicited on-demand blocks."""

import asyncio
import random
from dataclasses import replace
from typing import Any

import pytest
from structlog.testing import capture_logs

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import NO_REPLY_CAUSES, ComputerLink
from gateway.protocols.vigor import Vigor
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, WriteResult, WriteRule
from tests.sim.bench import Bench, Unruly
from tests.sim.links import commands, link_device, link_plant, link_station, spelt
from tests.sim.plant import (
    SECOND,
    Plant,
    clock_word,
    clockwork,
    device,
    made_device,
    make_tag,
    plant,
    running,
)
from tests.sim.virtual import on_virtual_time, run_virtual
from tests.sim.witness import Witness

ONE_FORMAT = WireTiming(19200, 10)  # 7E1, of all of them
NUMBERS = (0, 300, 600)


def mixed(every: float = 0.3) -> Plant:
    """A Vigor, a format 1 and a format 4 PLC."""
    vigor = Vigor(station=1)
    tags = [
        make_tag(f"D{n}", vigor, device="vigor", every=every, type="uint16", write=WriteRule())
        for n in NUMBERS
    ]
    times = replace(vigor.timing, reply_timeout=0.3)
    devices = [made_device("vigor", vigor, ONE_FORMAT, times, tuple(tags), 0.3)]
    stations: list[Any] = [VigorStation(1)]
    for number, frame_format in ((5, 1), (6, 4)):
        driver = ComputerLink(station=number, frame_format=frame_format)  # type: ignore[arg-type]
        addresses = [f"D{n}" for n in NUMBERS]
        settings: dict[str, Any] = {"type": "uint16", "write": WriteRule(), "every": every}
        devices.append(link_device(driver, *addresses, wire=ONE_FORMAT, **settings))
        stations.append(link_station(driver))
    for station in stations:
        clockwork(station.memory, NUMBERS)
    unruly = [Unruly(station, seed, wire=ONE_FORMAT) for seed, station in enumerate(stations)]
    return Plant(devices, unruly, Bench(), ONE_FORMAT)


def wrong(line: Plant) -> list[tuple[float, str, object]]:
    """Good values that their station cannot have held during the last second."""
    found: list[tuple[float, str, object]] = []
    for at, sample in line.reported:
        n, value = sample.tag.address.number, sample.value
        if sample.quality is Quality.GOOD and isinstance(value, int):
            assert sample.time == int(at * SECOND)
            if (clock_word(at, n) - value) % 65536 > 300:
                found.append((at, sample.tag.key, value))
    return found


@on_virtual_time
async def test_three_protocol_variants_on_one_wire_are_all_healthy() -> None:
    line = mixed()
    async with running(line):
        await asyncio.sleep(30)
        for dev in line.devices:
            assert line.good(dev), dev.name
            assert dev.record.failures == {}
            assert dev.record.unasked == 0
            assert len(line.reads(dev)) > 80
        for dev in line.devices:
            outcome = line.submit(dev, dev.tags[0], 4711)
            await asyncio.sleep(1)
            assert isinstance(outcome.once, WriteResult)
            assert line.now[dev.tags[0]].value == 4711
    assert [s.memory.read("D", 0)[0] for s in line.stations] == [4711] * 3
    assert not [w for w in wrong(line) if w[2] != 4711]


@pytest.mark.parametrize("dead", [0, 1, 2])
@on_virtual_time
async def test_a_mute_plc_does_not_disturb_the_others(dead: int) -> None:
    line = mixed()
    async with running(line):
        await asyncio.sleep(5)
        line.stations[dead].mute = True
        await asyncio.sleep(60)
        for i, dev in enumerate(line.devices):
            assert (dev.state is State.OFFLINE) == (i == dead)
            assert line.good(dev) == (i != dead)
        line.stations[dead].mute = False
        await asyncio.sleep(90)
        assert all(line.good(dev) for dev in line.devices)
    assert wrong(line) == []


@on_virtual_time
async def test_late_and_lost_replies_never_make_a_wrong_value() -> None:
    """Each resync sends a loopback whose text was never sent before."""
    line = mixed(every=0.2)
    for station in line.stations:
        station.late = lambda c: 0.3 + c.uniform(0.05, 0.5) if c.random() < 0.1 else 0.0
        station.lose, station.cut = 0.03, 0.03
    checks = Witness(line)
    async with running(line):
        await asyncio.sleep(2000)
    assert checks.wrong == []
    assert checks.right > 10_000
    for dev, station in zip(line.devices[1:], line.stations[1:], strict=True):
        assert dev.record.late > 20
        assert commands(station).count("TT") > 20
        texts = {data[9:] for _, data in station.heard if data[5:7] == b"TT"}
        assert len(texts) == commands(station).count("TT")  # no two are equal


@on_virtual_time
async def test_nak_06_finds_the_one_refused_address_of_a_block() -> None:
    dev = link_device(ComputerLink(station=5), *[f"D{n}" for n in range(40)])
    line = link_plant([dev])
    line.stations[0].inner.memory.holes = {("D", 17)}
    for n in range(40):
        line.stations[0].memory.write("D", n, [n])
    async with running(line):
        await asyncio.sleep(4)
        for tag in dev.tags:
            if tag.text == "D17":
                assert line.reason(tag) is Reason.REFUSED
                assert "06" in line.now[tag].detail
            else:
                assert line.now[tag].value == tag.address.number
        assert [block.span.size for block in dev.blocks] == [17, 1, 22]
        assert dev.record.failures == {}


# On-demand blocks


def talkative(*, monitor: bool = False) -> tuple[Plant, Device]:
    addresses = [f"D{n}" for n in range(0, 3000, 400)]
    driver = ComputerLink(station=5, monitor=monitor)
    dev = link_device(driver, *addresses, every=1.0, type="uint16")
    line = link_plant([dev])
    clockwork(line.stations[0].memory, [int(text[1:]) for text in addresses])
    return line, dev


def on_demand(line: Plant, data: str = "1E61") -> bytes:
    return line.stations[0].inner.on_demand(data)  # type: ignore[attr-defined,no-any-return]


@pytest.mark.parametrize("monitor", [False, True])
@on_virtual_time
async def test_an_on_demand_block_before_a_reply_is_counted_and_no_reply(
    monitor: bool,
) -> None:
    """The block has the shape of the reply, except for its PC number FE."""
    line, dev = talkative(monitor=monitor)
    station = line.stations[0]
    chance, sent = random.Random(1), 0

    def chatty(data: bytes, now: float) -> list[bytes]:
        nonlocal sent
        replies = station.inner.hear(data, now)
        if replies and replies[0][:1] == b"\x02" and chance.random() < 0.5:
            size = len(replies[0]) - 8
            sent += 1
            return [on_demand(line, "7" * size), *replies]
        return replies

    station.answer = chatty
    checks = Witness(line)
    async with running(line):
        await asyncio.sleep(60)
    assert sent > 25
    assert sent - dev.record.unasked in (0, 1)  # perhaps one is on its way
    assert checks.wrong == []
    assert checks.right > 400
    assert dev.record.failures == {}


@on_virtual_time
async def test_an_on_demand_block_between_transactions_is_counted_and_no_reply() -> None:
    line, dev = talkative()
    checks, sent = Witness(line), 0
    async with running(line):
        await asyncio.sleep(2)
        for _ in range(50):
            await asyncio.sleep(0.17)
            while not line.line.engine.is_idle:
                await asyncio.sleep(0.002)
            block = on_demand(line)
            for start in range(0, len(block), 4):
                line.bench.received(block[start : start + 4])
            sent += 1
    assert sent - dev.record.unasked in (0, 1)  # perhaps one is on its way
    assert line.line.engine.record.unasked >= sent * 12
    assert checks.wrong == []
    assert dev.record.failures == {}


def test_on_demand_blocks_are_logged_at_info_only_now_and_then() -> None:
    async def whole() -> None:
        line, _ = talkative()
        async with running(line):
            await asyncio.sleep(2)
            for _ in range(100):
                await asyncio.sleep(0.25)
                while not line.line.engine.is_idle:
                    await asyncio.sleep(0.002)
                line.bench.received(on_demand(line))

    with capture_logs() as logs:
        run_virtual(whole())
    strays = [entry for entry in logs if entry["event"] == "stray frame"]
    assert len(strays) == 100
    assert {entry["what"] for entry in strays} == {"on-demand data of station 5: 1E61"}
    at_info = [entry for entry in strays if entry["log_level"] == "info"]
    assert len(at_info) == 3
    assert at_info[-1]["count"] > at_info[0]["count"] == 1


@on_virtual_time
async def test_an_on_demand_block_instead_of_a_reply_is_no_reply() -> None:
    line, dev = talkative()
    station = line.stations[0]
    async with running(line):
        await asyncio.sleep(2)
        station.answer = lambda data, now: (
            [on_demand(line, "7777")] if station.inner.hear(data, now) else []
        )
        await asyncio.sleep(8)
        assert dev.state is State.OFFLINE
        assert 0x7777 not in {sample.value for _, sample in line.reported}
        assert all(line.now[tag].quality is Quality.BAD for tag in dev.tags)


# Diagnosis


@on_virtual_time
async def test_the_diagnosis_of_a_silent_plc_names_the_known_causes() -> None:
    dev = link_device(ComputerLink(station=5), "D0")
    line = link_plant([dev])
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].mute = True
        await asyncio.sleep(10)
        assert dev.state is State.OFFLINE
        assert "station number" in dev.diagnosis()
        assert NO_REPLY_CAUSES in dev.diagnosis()
        for number in ("6301", "6305", "6306", "D8121"):
            assert number in dev.diagnosis()
        assert NO_REPLY_CAUSES in line.now[spelt(dev, "D0")].detail


@on_virtual_time
async def test_the_diagnosis_of_other_protocols_does_not_name_them() -> None:
    dev = device([make_tag("D0")])
    line = plant([dev])
    line.stations[0].mute = True
    async with running(line):
        await asyncio.sleep(10)
        assert "No byte came back" in dev.diagnosis()
        assert "6301" not in dev.diagnosis()
