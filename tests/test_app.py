"""A running gateway without Zenoh: published samples, fresh reads, writes."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gateway.config import ZenohMode, load
from gateway.errors import BadValue, LineDown, Offline
from gateway.parts.transfers.forecast import forecasts
from gateway.plant.on_demand import FRESH_WITHIN
from gateway.plant.plant import Plant
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, Sample, Tag, good
from gateway.transport import Receiver
from tests.e2e.processes import vigor_line, write_config
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.virtual import on_virtual_time
from tests.writing import write

TAGS = {
    "speed": {"address": "D10"},
    "door": {"address": "M12"},
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
}


class Watched:
    """A gateway, and all that it published."""

    def __init__(self, gateway: Plant) -> None:
        self.gateway = gateway
        self.published: list[Sample] = []
        self.online_changes: list[tuple[str, bool]] = []
        self._changed = asyncio.Event()
        gateway.subscribe(self)

    def publish(self, samples: Sequence[Sample]) -> None:
        self.published += samples
        self._changed.set()

    def set_online(self, device: str, online: bool) -> None:
        self.online_changes.append((device, online))
        self._changed.set()

    def latest(self, key: str) -> Sample | None:
        return next((s for s in reversed(self.published) if s.tag.key == key), None)

    async def until_good(self, *keys: str) -> None:
        def good(key: str) -> bool:
            sample = self.latest(key)
            return sample is not None and sample.quality is Quality.GOOD

        async with asyncio.timeout(300):
            while not all(good(key) for key in keys):
                self._changed.clear()
                await self._changed.wait()


def made(folder: Path, **device: Any) -> Watched:
    every = device.pop("every", "200ms")
    lines = {"hall": vigor_line("simulator", TAGS, **device)}
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines, defaults={"every": every})
    return Watched(Plant(load(path)))


@asynccontextmanager
async def running(watched: Watched) -> AsyncIterator[Watched]:
    tasks = [asyncio.create_task(line.run()) for line in watched.gateway.lines]
    yield watched
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def tag(watched: Watched, name: str) -> Any:
    found = watched.gateway.tag(f"mixer/{name}")
    assert found is not None
    return found


def test_before_the_lines_run_every_tag_is_starting(tmp_path: Path) -> None:
    watched = made(tmp_path)
    for name in TAGS:
        sample = watched.gateway.sample(tag(watched, name))
        assert (sample.value, sample.quality, sample.reason) == (None, Quality.BAD, Reason.STARTING)
    assert watched.gateway.tag("mixer/missing") is None


async def test_a_line_that_is_not_planned_refuses_writes(
    tmp_path: Path,
) -> None:
    lines = {"hall": vigor_line("simulator", TAGS)}
    path = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)
    watched = Watched(Plant(load(path), plan_now=False))
    gateway, recipe = watched.gateway, tag(watched, "recipe")
    with pytest.raises(LineDown, match="line hall is not open"):
        await write(gateway, recipe, 7)
    assert (await gateway.fresh(recipe, 0.0)).reason is Reason.STARTING
    assert {"status", "devices/mixer"} <= gateway.status().keys()
    assert "lines/hall" not in gateway.status()
    [line] = gateway.lines
    gateway.planned(line, gateway.plan(line))
    assert "lines/hall" in gateway.status()
    async with running(watched):
        await watched.until_good("mixer/recipe")
        assert (await write(gateway, recipe, 7)).acknowledged


async def test_values_are_published_and_kept(tmp_path: Path) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good(*(f"mixer/{name}" for name in TAGS))
        assert watched.online_changes == [("mixer", True)]
        for name in TAGS:
            sample = watched.gateway.sample(tag(watched, name))
            assert sample.quality is Quality.GOOD
            assert abs(sample.time - time.time_ns()) < 5e9


async def test_a_verified_write_returns_the_value_of_the_device(tmp_path: Path) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good("mixer/recipe")
        written = await write(watched.gateway, tag(watched, "recipe"), 7)
        assert (written.value, written.verified, written.acknowledged) == (7, True, True)
        assert 0 < written.took < 5
        fresh = await watched.gateway.fresh(tag(watched, "recipe"), 0.0)
        assert fresh.value == 7


@pytest.mark.parametrize("value", [0, 41, 1.5, "AB", True])
async def test_a_bad_value_is_never_sent(tmp_path: Path, value: Any) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good("mixer/recipe")
        with pytest.raises(BadValue):
            await write(watched.gateway, tag(watched, "recipe"), value)
        [line] = watched.gateway.lines
        assert line.engine.devices[0].record.writes == 0


async def test_a_write_to_a_line_that_is_not_open_fails_at_once(tmp_path: Path) -> None:
    watched = made(tmp_path)
    with pytest.raises(LineDown):
        await write(watched.gateway, tag(watched, "recipe"), 7)


async def test_a_disabled_device_gets_no_request(tmp_path: Path) -> None:
    async with running(made(tmp_path, enabled=False)) as watched:
        gateway = watched.gateway
        assert {gateway.sample(tag(watched, name)).reason for name in TAGS} == {Reason.DISABLED}
        with pytest.raises(Offline, match="device mixer is disabled"):
            await write(gateway, tag(watched, "recipe"), 7)
        assert (await gateway.fresh(tag(watched, "speed"), 0.0)).reason is Reason.DISABLED
        assert [line.engine.devices for line in gateway.lines] == [[]]


async def test_a_fresh_value_is_read_on_demand(tmp_path: Path) -> None:
    async with running(made(tmp_path, every="1h")) as watched:
        await watched.until_good("mixer/speed")
        known = watched.gateway.sample(tag(watched, "speed"))
        assert await watched.gateway.fresh(tag(watched, "speed"), 3600.0) == known
        before = time.time_ns()
        fresh = await watched.gateway.fresh(tag(watched, "speed"), 0.0)
        assert (fresh.quality, fresh.time > known.time) == (Quality.GOOD, True)
        assert fresh.time >= before


async def test_simultaneous_clients_share_one_read(tmp_path: Path) -> None:
    async with running(made(tmp_path, every="1h")) as watched:
        await watched.until_good(*(f"mixer/{name}" for name in TAGS))
        [device] = watched.gateway.lines[0].engine.devices
        before = device.record.exchanges
        speed = tag(watched, "speed")
        samples = await asyncio.gather(*(watched.gateway.fresh(speed, 0.0) for _ in range(50)))
        assert len({sample.time for sample in samples}) == 1
        assert device.record.exchanges == before + 1


async def test_on_a_line_that_is_not_open_fresh_returns_the_last_sample(tmp_path: Path) -> None:
    watched = made(tmp_path)
    sample = await watched.gateway.fresh(tag(watched, "speed"), 0.0)
    assert (sample.value, sample.quality) == (None, Quality.BAD)


@asynccontextmanager
async def slow_line(
    folder: Path, every: str = "1s"
) -> AsyncIterator[tuple[Watched, Unruly, Bench]]:
    """A line with one station that reads its memory at once and replies 0.4 s later."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}}, reply_timeout="2s")}
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines, defaults={"every": every})
    station, bench = Unruly(VigorStation(1), late=lambda _: 0.4), Bench()
    opened = partial(bench.open, [station], WIRE)
    async with running(Watched(Plant(load(path), open_line=lambda _: opened))) as watched:
        await watched.until_good("mixer/speed")
        yield watched, station, bench


async def until_read(station: Unruly) -> None:
    """Waits for the next request at the station. The reply holds the values of this moment."""
    before = len(station.heard)
    while len(station.heard) == before:
        await asyncio.sleep(0.001)


@pytest.mark.parametrize("max_age", [0.0, 0.1])
@on_virtual_time
async def test_a_read_that_started_before_the_request_does_not_satisfy_it(
    tmp_path: Path, max_age: float
) -> None:
    async with slow_line(tmp_path) as (watched, station, _):
        await until_read(station)
        station.memory.write("D", 10, [4711])
        fresh = await watched.gateway.fresh(tag(watched, "speed"), max_age)
        assert fresh.value == 4711


@on_virtual_time
async def test_a_sample_of_this_moment_is_not_younger_than_0_s(tmp_path: Path) -> None:
    async with slow_line(tmp_path, every="1h") as (watched, station, _):
        for value in (1, 2, 3):
            station.memory.write("D", 10, [value])
            assert (await watched.gateway.fresh(tag(watched, "speed"), 0.0)).value == value


@on_virtual_time
async def test_port_loss_ends_the_wait_for_a_fresh_value_at_once(
    tmp_path: Path,
) -> None:
    async with slow_line(tmp_path) as (watched, station, bench):
        await until_read(station)
        asking = asyncio.create_task(watched.gateway.fresh(tag(watched, "speed"), 0.0))
        await asyncio.sleep(0)
        bench.vanish()
        since = asyncio.get_running_loop().time()
        assert (await asking).reason is Reason.LINE_DOWN
        assert asyncio.get_running_loop().time() - since < FRESH_WITHIN / 2


@on_virtual_time
async def test_a_read_that_starts_at_the_time_of_the_request_is_repeated(
    tmp_path: Path,
) -> None:
    """Some clocks have ticks of 15 ms."""
    watched = made(tmp_path)
    gateway, speed, expedited = watched.gateway, tag(watched, "speed"), list[Tag]()
    [line] = gateway.lines
    [poll] = [
        p for p in line.engine.schedule.polls(line.engine.devices[0]) if speed in p.block.tags
    ]
    line.engine.is_open = True
    # No line runs: only the call is of interest.
    line.expedite = lambda device, tag: expedited.append(tag)  # type: ignore[method-assign]
    poll.asked = 7.0
    asking = asyncio.create_task(gateway.fresh(speed, 0.0))
    await asyncio.sleep(0)
    assert expedited == [speed]
    gateway.samples([good(speed, 1, time.time_ns())])
    assert expedited == [speed, speed]
    poll.asked = 7.015
    gateway.samples([good(speed, 2, time.time_ns())])
    assert (await asking).value == 2


@on_virtual_time
async def test_fresh_returns_the_last_sample_of_an_unsolicited_tag_at_once(tmp_path: Path) -> None:
    reader = {
        "protocol": "frames",
        "framing": {"header": "<STX>", "terminator": "<ETX>"},
        "listen": {"scan": {"match": "(?P<code>[0-9]+)", "fields": {"code": {"type": "text"}}}},
        "tags": {"code": {"address": "code", "event": True}},
    }
    lines = {"door": {"port": "/dev/ttyS1", "devices": {"reader": reader}}}
    path = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)
    receivers: list[Receiver] = []

    class Mute:
        async def close(self) -> None:
            pass

    async def opened(receiver: Receiver) -> Any:
        receivers.append(receiver)
        return Mute()

    async with running(Watched(Plant(load(path), open_line=lambda _: opened))) as watched:
        await asyncio.sleep(1)
        gateway, since = watched.gateway, asyncio.get_running_loop().time()
        code = gateway.tag("reader/code")
        assert code is not None
        assert (await gateway.fresh(code, 0.0)).reason is Reason.STARTING
        receivers[0].received(b"\x024006381333931\x03")
        for max_age in (0.0, 60.0):
            assert (await gateway.fresh(code, max_age)).value == "4006381333931"
        assert asyncio.get_running_loop().time() == since


def test_a_republished_change_within_the_deadband_reaches_every_subscriber(
    tmp_path: Path,
) -> None:
    """History needs it too: its next sample is compared with this one."""
    lines = {"hall": vigor_line("simulator", {"level": {"address": "D10", "deadband": 5}})}
    path = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)
    watched = Watched(Plant(load(path)))
    gateway, level = watched.gateway, tag(watched, "level")
    published = watched.published
    for value in (100, 104):
        gateway.samples([good(level, value, time.time_ns())])
    assert [sample.value for sample in published] == [100]
    for _ in range(2):
        gateway.mark_published([gateway.sample(level)])
    assert [sample.value for sample in published] == [100, 104]
    gateway.samples([good(level, 96, time.time_ns())])
    assert [sample.value for sample in published] == [100, 104, 96]


def test_zenoh_gets_the_files_settings(tmp_path: Path) -> None:
    watched = made(tmp_path)
    settings = watched.gateway.config.zenoh
    assert (settings.prefix, settings.mode) == ("plant", ZenohMode.PEER)
    assert settings.listen == ("tcp/127.0.0.1:7447",)


def test_the_forecast_has_the_blocks_of_the_running_lines(tmp_path: Path) -> None:
    watched = made(tmp_path)
    [expected] = forecasts(watched.gateway.config)
    [line] = watched.gateway.lines
    assert [row.block.span for row in expected.blocks] == [
        block.span for device in line.engine.devices for block in device.blocks
    ]
