"""Stations that do not reply: their values turn bad, the others keep their reads."""

import asyncio
import itertools

import pytest

from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import Offline
from gateway.planning.bad_addresses import SPLIT_FIRST
from gateway.planning.wire_timing import WireTiming
from gateway.tags import Quality, Reason, WriteRule
from tests.line.clocks import clocks, wind_up
from tests.sim.plant import device, make_tag, plant, running
from tests.sim.virtual import now, on_virtual_time


@on_virtual_time
async def test_a_mute_station_turns_bad_within_two_intervals_and_good_after_a_probe() -> None:
    dev = clocks(10, 10, every=1.0)
    others = [clocks(10, station=n) for n in (2, 3)]
    line = plant([dev, *others])
    wind_up(line)
    async with running(line):
        for _ in range(6):
            await asyncio.sleep(7.3)
            muted, line.stations[0].mute = now(), True
            await asyncio.sleep(10)
            for tag in dev.tags:
                assert line.turned(tag, Quality.BAD, muted) - muted <= 2 * 1.0 + 0.5 + 0.1
            assert line.reason(dev.tags[0]) is Reason.NO_REPLY
            back, line.stations[0].mute = now(), False
            probes = len(line.stations[0].heard)
            await asyncio.sleep(65)
            first = line.stations[0].heard[probes][0]
            for tag in dev.tags:
                assert line.turned(tag, Quality.GOOD, back) - first < 1.0


@on_virtual_time
async def test_when_all_stations_fall_silent_at_once_all_values_turn_bad() -> None:
    devices = [clocks(10, station=n, every=1.0) for n in range(1, 21)]
    line = plant(devices)
    wind_up(line)
    async with running(line):
        await asyncio.sleep(10)
        for station in line.stations:
            station.mute = True
        muted = now()
        await asyncio.sleep(60)
        for dev in devices:
            assert line.turned(dev.tags[0], Quality.BAD, muted) - muted <= 2 * 1.0 + 1.0 + 0.6


@on_virtual_time
async def test_a_mute_station_does_not_turn_the_values_of_others_bad() -> None:
    devices = [clocks(10, station=n, every=0.2) for n in range(1, 4)]
    line = plant(devices)
    wind_up(line)
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].mute = True
        since = now()
        await asyncio.sleep(120)
    for dev in devices[1:]:
        assert all(
            s.quality is Quality.GOOD
            for at, s in line.reported
            if at > since and s.tag is dev.tags[0]
        )


@pytest.mark.parametrize(("healthy", "mute"), [(4, 1), (1, 31)])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("first", [False, True])
@on_virtual_time
async def test_healthy_stations_keep_95_percent_of_their_reads(
    healthy: int, mute: int, full: bool, first: bool
) -> None:
    """Counted once each mute station has timed out twice. Before, a part of the reads is enough.

    On a full line probes get a twentieth of the time, on others the idle time too.
    """
    every, span = (0.05, 120) if full else (1.0, 400)
    devices = [clocks(20, station=n, every=every) for n in range(1, healthy + mute + 1)]
    alive = devices[:healthy] if first else devices[mute:]

    async def reads(dead: bool) -> tuple[int, int, float]:
        fresh = [clocks(20, station=n, every=every) for n in range(1, healthy + mute + 1)]
        line = plant(fresh if dead else [d for d in fresh if d.name in [a.name for a in alive]])
        wind_up(line)
        for dev, station in zip(line.devices, line.stations, strict=True):
            station.mute = dev.name not in [a.name for a in alive]
        async with running(line):
            await asyncio.sleep(2)
            start = now()
            await asyncio.sleep(2.5 * mute)
            settled = now()
            await asyncio.sleep(span)
        ok = [d for d in line.devices if d.name in [a.name for a in alive]]
        probed = sum(
            later - at
            for (at, data), (later, _) in itertools.pairwise(line.bench.sent)
            if at >= settled and int(data[1:3], 16) not in [d.driver.station for d in ok]
        )
        settling = sum(sum(at < settled for at in line.reads(d, start)) for d in ok)
        return settling, sum(len(line.reads(d, settled)) for d in ok), probed / span

    with_mute, kept, probing = await reads(dead=True)
    without, best, _ = await reads(dead=False)
    assert kept >= (0.95 if full else 0.98) * best
    if full:
        assert probing <= 0.05
    if first or mute == 1:
        assert with_mute >= (0.3 if full else 0.8) * without


@on_virtual_time
async def test_silent_stations_are_probed_on_a_full_line_too() -> None:
    devices = [clocks(60, 60, station=n, every=0.05) for n in (1, 2)]
    line = plant(devices)
    wind_up(line)
    line.stations[1].mute = True
    async with running(line):
        await asyncio.sleep(30)
        assert not line.good(devices[1])
        line.stations[1].mute = False
        await asyncio.sleep(30)
        assert line.good(devices[1])


@on_virtual_time
async def test_writes_to_a_silent_station_do_not_occupy_the_line() -> None:
    devices = [
        device([make_tag("D0", write=WriteRule(), device=f"p{n}")], station=n) for n in (1, 2)
    ]
    line = plant(devices)
    line.stations[1].mute = True
    async with running(line):
        await asyncio.sleep(5)
        start = now()
        outcomes = []
        for value in range(600):
            outcomes.append(line.submit(devices[1], devices[1].tags[0], value))
            await asyncio.sleep(0.1)
        probes = [at for at, data in line.bench.sent if at >= start and data[1:3] == b"02"]
        assert len(probes) <= 61  # short ones, one a second at most
        await asyncio.sleep(WRITE_EXPIRY)
        assert all(isinstance(o.once, Offline) for o in outcomes)
        assert line.writes_sent() == []
        assert len(line.reads(devices[0], start)) >= 59


@on_virtual_time
async def test_a_block_without_replies_is_read_in_parts_and_does_not_occupy_the_line() -> None:
    """The station replies to other requests, so it stays online. It is silent for 40 words."""
    odd, other = clocks(3, 40, station=1, every=0.5), clocks(10, station=2, every=0.2)
    line = plant([odd, other])
    wind_up(line)
    station = line.stations[0]
    station.answer = lambda data, now: (
        [] if data[9:11] == b"50" else station.inner.hear(data, now)  # 80 bytes
    )
    async with running(line):
        await asyncio.sleep(60)
        start = now()
        await asyncio.sleep(600)
        assert line.good(odd)
        assert sorted(block.span.size for block in odd.blocks) == [3, 20, 20]
        assert len(line.reads(other, start)) >= 0.95 * 600 / 0.2
        station.answer = None
        await asyncio.sleep(2 * SPLIT_FIRST)
        assert line.good(odd)
        assert sorted(block.span.size for block in odd.blocks) == [3, 40]


@on_virtual_time
async def test_31_stations_return_together_on_a_free_wire_within_3_seconds() -> None:
    wire = WireTiming(57600, 10)
    devices = [clocks(10, station=n, every=20.0, wire=wire) for n in range(1, 33)]
    line = plant(devices, wire=wire)
    wind_up(line)
    async with running(line):
        await asyncio.sleep(30)
        for station in line.stations[1:]:
            station.mute = True
        await asyncio.sleep(300)  # more probes than can be told apart
        assert not any(line.good(dev) for dev in devices[1:])
        for station in line.stations[1:]:
            station.mute = False
        await asyncio.sleep(3)
        assert all(line.good(dev) for dev in devices)


@on_virtual_time
async def test_a_write_does_not_wait_for_the_patient_probe_of_a_silent_station() -> None:
    devices = [
        device([make_tag("D0", write=WriteRule(), device=f"p{n}")], station=n) for n in (1, 2)
    ]
    line = plant(devices)
    async with running(line):
        await asyncio.sleep(5)
        line.stations[1].mute = True
        await asyncio.sleep(20)
        took = []
        for value in range(1500):
            outcome = line.submit(devices[0], devices[0].tags[0], value)
            await asyncio.sleep(0.2)
            took.append(outcome.at - outcome.asked)
        assert max(took) < 0.15
