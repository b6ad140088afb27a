"""Faults that the simulation found, one test each, with the seed of `make sim`."""

import asyncio
import json
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import Busy
from gateway.plant.plant import Plant as Gateway
from gateway.protocols.computer_link import ComputerLink
from gateway.tags import Quality, Reason, Sample
from tests.sim.bench import Bench, Unruly
from tests.sim.links import link_device, link_station
from tests.sim.plant import Plant, device, plant, running, words
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


class Reads:
    """Notes the times of good samples."""

    def __init__(self, reads: list[float]) -> None:
        self._reads = reads

    def publish(self, samples: Sequence[Sample]) -> None:
        now = asyncio.get_running_loop().time()
        self._reads += [now for sample in samples if sample.quality is Quality.GOOD]

    def set_online(self, device: str, online: bool) -> None: ...


@on_virtual_time
async def test_seed_4_lean_a_clock_set_back_makes_no_old_value_fresh(tmp_path: Path) -> None:
    """After an hour back, the value of a minute ago had a time in the future."""
    loop = asyncio.get_running_loop()
    set_back = 0

    def wall() -> int:
        return int(loop.time() * SECOND) - set_back

    config = load(_file(tmp_path, speed={"address": "D100", "every": "10min", "publish": "always"}))
    gateway = Gateway(config, wall)
    (tag,) = (tag for found in config.devices for tag in found.tags)
    reads: list[float] = []
    gateway.subscribe(Reads(reads))
    async with _lines_of(gateway):
        await asyncio.sleep(60)
        known = len(reads)
        set_back = 3600 * SECOND
        await gateway.fresh(tag, 5.0)
        assert len(reads) == known + 1


@on_virtual_time
async def test_a_client_that_gave_up_is_not_remembered(tmp_path: Path) -> None:
    """A silent device sends no sample, so no sample removes the waiting clients."""
    config = load(_file(tmp_path, speed={"address": "D100", "every": "1h"}))
    gateway = Gateway(config)
    (tag,) = (tag for found in config.devices for tag in found.tags)
    (line,) = gateway.lines
    async with _lines_of(gateway):
        await asyncio.sleep(5)
        # No read follows a request.
        line.expedite = lambda *_: None  # type: ignore[method-assign]
        for _ in range(3):
            with pytest.raises(Busy):
                await gateway.fresh(tag, 0.0)
    assert not gateway._on_demand.waiting  # private: a leak shows in no public figure


@on_virtual_time
async def test_seed_0_busy_expedited_polls_leave_no_entries() -> None:
    """A client reads all the time a block that is due once a day."""
    mixer = device(words(100, 1, every=86_400.0))
    hall = plant([mixer])
    async with running(hall):
        await asyncio.sleep(2)
        for _ in range(1000):
            hall.line.expedite(mixer, mixer.tags[0])
            await asyncio.sleep(0.1)
        assert len(hall.reads(mixer)) > 900
        # Private: a leak shows in no public figure.
        assert len(hall.line.engine.schedule._queue.waiting) < 100


@on_virtual_time
async def test_seed_118_lean_one_refusal_does_not_make_a_good_address_bad() -> None:
    """A request lost one character; the rest had a right sum and a bad address."""
    mixer = device(words(100, 1))
    hall = plant([mixer])
    station = hall.stations[0]
    async with running(hall):
        await asyncio.sleep(5)
        station.inner.memory.holes.add(("D", 100))
        asked = len(station.heard)
        while len(station.heard) == asked:
            await asyncio.sleep(0.001)
        station.inner.memory.holes.clear()
        since = asyncio.get_running_loop().time()
        await asyncio.sleep(3)
        assert hall.reads(mixer, since)
        assert not [sample for _, sample in hall.reported if sample.reason is Reason.REFUSED]
        # The second refusal in a row makes the address bad.
        station.inner.memory.holes.add(("D", 100))
        await asyncio.sleep(3)
        assert hall.reason(mixer.tags[0]) is Reason.REFUSED


@pytest.mark.parametrize("echo", [False, True], ids=["plain", "echo"])
@on_virtual_time
async def test_seeds_0_and_2_lean_a_broadcast_is_followed_by_a_pause(
    echo: bool,
) -> None:
    """The measured turnaround of one PLC does not shorten it, and an echo does not end it."""
    mixer = link_device(ComputerLink(station=1), "D100", every=0.02, control=True)
    hall = Plant([mixer], [Unruly(link_station(mixer.driver))], Bench(echo=echo))  # type: ignore[arg-type]
    async with running(hall):
        await asyncio.sleep(5)
        assert (mixer.turnaround.expected or 1.0) < 0.02  # measured
        answer = await hall.line.command(mixer, "global", "on")
        await asyncio.sleep(1)
    place = next(i for i, (_, data) in enumerate(hall.bench.sent) if data[5:7] == b"GW")
    (begin, data), (after, _) = hall.bench.sent[place : place + 2]
    assert answer == "sent to all stations, none answers"
    assert 0.1 <= after - (begin + len(data) * hall.wire.character) < 0.15


@on_virtual_time
async def test_seed_20_lean_an_address_that_returned_is_polled_as_often_as_before() -> None:
    """After its first good read it was due after the five minutes of a bad address."""
    mixer = device([*words(100, 1, every=5.0), *words(900, 1, every=5.0)])
    hall = plant([mixer])
    away = mixer.tags[1]
    async with running(hall):
        await asyncio.sleep(5)
        hall.stations[0].inner.memory.holes.add(("D", 900))
        await asyncio.sleep(20)
        assert hall.reason(away) is Reason.REFUSED
        hall.stations[0].inner.memory.holes.clear()
        await asyncio.sleep(400)
        good = [
            at for at, sample in hall.reported if sample.tag is away and sample.value is not None
        ]
        assert asyncio.get_running_loop().time() - good[-1] < 6.0
        assert len([at for at in good if at > good[-1] - 52]) > 10


def test_seed_13_storm_polls_queued_behind_a_late_one_leave_no_entries() -> None:
    """Writes use up the share of one device: its polls wait, those of the other do not."""
    greedy, modest = device(words(100, 1, every=0.1)), device(words(200, 2, every=0.1), station=2)
    schedule, now = Schedule([greedy, modest], 0.0), 0.0
    for each in (greedy, modest):
        each.health.answered()
        schedule.came_online(each, now)
    for _ in range(2000):
        now += 0.5
        greedy.used(now, now - 5.0)
        job = schedule.next(now)
        assert isinstance(job, PollEntry)
        assert job.device is modest
        schedule.polled(job, now)
    assert schedule._queue.entries < 200  # private: a leak shows in no public figure


def test_seed_7_lean_polls_of_an_older_plan_leave_no_entries() -> None:
    """The device is planned again and again; the polls of older plans are stale."""
    mixer = device(words(100, 2, every=86_400.0))
    schedule = Schedule([mixer], 0.0)
    mixer.health.answered()
    schedule.came_online(mixer, 0.0)
    job = schedule.next(0.0)
    assert isinstance(job, PollEntry)
    schedule.polled(job, 0.0)
    for _ in range(1000):
        schedule.plan(mixer, 1.0)
    assert len(schedule.polls(mixer)) == 1
    assert len(schedule._queue.waiting) < 100  # private: a leak shows in no public figure
