"""What simulated hours of faults found, one test each; `make sim` found them by these seeds."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.app import Gateway
from gateway.config import load
from gateway.errors import Busy
from gateway.tags import Quality, Reason
from tests.sim.plant import device, plant, running, words
from tests.sim.virtual import on_virtual_time

SECOND = 1_000_000_000


def _file(folder: Path, **tags: Any) -> Path:
    path = folder / "config.yaml"
    devices = {"plc": {"protocol": "vigor", "station": 1, "tags": tags}}
    path.write_text(json.dumps({"lines": {"hall": {"port": "simulator", "devices": devices}}}))
    return path


@asynccontextmanager
async def _lines_of(gateway: Gateway) -> AsyncIterator[None]:
    tasks = [asyncio.create_task(line.run()) for line in gateway.lines]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@on_virtual_time
async def test_seed_4_lean_a_clock_set_back_makes_no_old_value_fresh(tmp_path: Path) -> None:
    """An hour back, and a value of a minute ago seemed to come from the future."""
    loop = asyncio.get_running_loop()
    set_back = 0

    def wall() -> int:
        return int(loop.time() * SECOND) - set_back

    config = load(_file(tmp_path, speed={"address": "D100", "every": "10min", "publish": "always"}))
    gateway = Gateway(config, wall)
    (tag,) = (tag for found in config.devices for tag in found.tags)
    reads: list[float] = []
    gateway.publish = lambda samples: reads.extend(
        loop.time() for sample in samples if sample.quality is Quality.GOOD
    )
    async with _lines_of(gateway):
        await asyncio.sleep(60)
        known = len(reads)
        set_back = 3600 * SECOND
        await gateway.fresh(tag, 5.0)
        assert len(reads) == known + 1


@on_virtual_time
async def test_nobody_who_asked_in_vain_is_remembered(tmp_path: Path) -> None:
    """While a device is silent no sample of it comes, however often it is asked for."""
    config = load(_file(tmp_path, speed={"address": "D100", "every": "1h"}))
    gateway = Gateway(config)
    (tag,) = (tag for found in config.devices for tag in found.tags)
    (line,) = gateway.lines
    async with _lines_of(gateway):
        await asyncio.sleep(5)
        line.refresh = lambda *_: None  # type: ignore[method-assign]  # nothing comes of it
        for _ in range(3):
            with pytest.raises(Busy):
                await gateway.fresh(tag, 0.0)
    assert not gateway._waiting


@on_virtual_time
async def test_seed_0_busy_hastened_polls_leave_no_places_behind() -> None:
    """Somebody looks all the time at what is read once a day."""
    mixer = device(words(100, 1, every=86_400.0))
    hall = plant([mixer])
    async with running(hall):
        await asyncio.sleep(2)
        for _ in range(1000):
            hall.line.refresh(mixer, mixer.tags[0])
            await asyncio.sleep(0.1)
        assert len(hall.reads(mixer)) > 900
        assert len(hall.line._schedule._waiting) < 100


@on_virtual_time
async def test_seed_118_lean_one_refusal_costs_an_address_that_was_there_no_five_minutes() -> None:
    """A character lost on the way, and the rest was a question with a right sum to nowhere."""
    mixer = device(words(100, 1))
    hall = plant([mixer])
    station = hall.stations[0]
    async with running(hall):
        await asyncio.sleep(5)
        station.inner.holes.add(("D", 100))
        asked = len(station.heard)
        while len(station.heard) == asked:
            await asyncio.sleep(0.001)
        station.inner.holes.clear()
        since = asyncio.get_running_loop().time()
        await asyncio.sleep(3)
        assert hall.reads(mixer, since)
        assert not [told for _, told in hall.told if told.reason is Reason.REFUSED]
        # Where it is gone for good, that is believed the second time.
        station.inner.holes.add(("D", 100))
        await asyncio.sleep(3)
        assert hall.reason(mixer.tags[0]) is Reason.REFUSED
