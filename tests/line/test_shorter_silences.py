"""A busy line learns a shorter silence before polls: what it gains, and what a station costs."""

import asyncio
from typing import Any

import pytest

from gateway.engine.results.shorter_silences import PAUSE
from tests.sim.plant import Plant, device, plant, running, words
from tests.sim.virtual import now, on_virtual_time

NEEDED = 0.003  # seconds that a station does not listen after a reply


def busy(stations: int, **timing: Any) -> Plant:
    """Makes a line whose polls need several times the wire's time."""
    return plant(
        [
            device(
                [*words(0, 5, every=0.01, device=f"plc{n}"), *words(300, 5, every=0.01)],
                station=n,
                **timing,
            )
            for n in range(1, stations + 1)
        ]
    )


async def reads(line: Plant, seconds: float) -> int:
    """Returns the number of good reads in the next seconds."""
    since = now()
    await asyncio.sleep(seconds)
    return sum(len(line.reads(each, since)) for each in line.devices)


@pytest.mark.parametrize("stations", [1, 3])
@on_virtual_time
async def test_a_busy_line_reads_more_often_after_it_learned(stations: int) -> None:
    line = busy(stations, learn_silence=False)
    async with running(line):
        await asyncio.sleep(10.0)
        before = await reads(line, 4.0)
    line = busy(stations)
    async with running(line):
        await asyncio.sleep(25.0)
        assert await reads(line, 4.0) >= 1.12 * before
        assert not any(each.record.failures for each in line.devices)


@on_virtual_time
async def test_a_station_that_needs_the_silence_loses_one_poll_and_stays_online() -> None:
    line = busy(3)
    line.stations[1].listens_after = NEEDED
    async with running(line):
        await asyncio.sleep(PAUSE / 3)
        first, second, third = line.devices
        assert second.record.failures == {"silence": 1}
        assert not first.record.failures
        assert not third.record.failures
        await asyncio.sleep(1.5 * PAUSE)
        assert second.record.failures == {"silence": 1}
        assert first.silence.shorter <= 0.0025 or third.silence.shorter <= 0.0025
        assert second.silence.shorter > NEEDED
        assert all(online for _, _, online in line.online_changes)
