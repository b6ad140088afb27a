"""From a configuration to a running gateway, without Zenoh: samples up, writes down."""

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gateway.app import FRESH_WITHIN, Gateway, forecasts
from gateway.config import ZenohMode, load
from gateway.errors import BadValue, LineDown, Offline
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, Sample, Tag, good
from gateway.transport import Receiver
from tests.e2e.processes import vigor_line, write_config
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.virtual import on_virtual_time

TAGS = {
    "speed": {"address": "D10"},
    "door": {"address": "M12"},
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}},
}


class Watched:
    """A gateway, and all it published."""

    def __init__(self, gateway: Gateway) -> None:
        self.gateway = gateway
        self.told: list[Sample] = []
        self.alive: list[tuple[str, bool]] = []
        self._news = asyncio.Event()
        gateway.subscribe(self)

    def publish(self, samples: Sequence[Sample]) -> None:
        self.told += samples
        self._news.set()

    def set_online(self, device: str, online: bool) -> None:
        self.alive.append((device, online))
        self._news.set()

    def latest(self, key: str) -> Sample | None:
        return next((s for s in reversed(self.told) if s.tag.key == key), None)

    async def until_good(self, *keys: str) -> None:
        def good(key: str) -> bool:
            sample = self.latest(key)
            return sample is not None and sample.quality is Quality.GOOD

        async with asyncio.timeout(10):
            while not all(good(key) for key in keys):
                self._news.clear()
                await self._news.wait()


def made(folder: Path, **device: Any) -> Watched:
    every = device.pop("every", "200ms")
    lines = {"hall": vigor_line("simulator", TAGS, **device)}
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines, defaults={"every": every})
    return Watched(Gateway(load(path)))


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


def test_before_it_runs_everything_is_starting(tmp_path: Path) -> None:
    watched = made(tmp_path)
    for name in TAGS:
        sample = watched.gateway.sample(tag(watched, name))
        assert (sample.value, sample.quality, sample.reason) == (None, Quality.BAD, Reason.STARTING)
    assert watched.gateway.tag("mixer/nobody") is None


async def test_values_are_published_and_kept(tmp_path: Path) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good(*(f"mixer/{name}" for name in TAGS))
        assert watched.alive == [("mixer", True)]
        for name in TAGS:
            sample = watched.gateway.sample(tag(watched, name))
            assert sample.quality is Quality.GOOD
            assert abs(sample.time - time.time_ns()) < 5e9


async def test_a_write_ends_with_what_the_device_holds(tmp_path: Path) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good("mixer/recipe")
        written = await watched.gateway.write(tag(watched, "recipe"), 7)
        assert (written.value, written.verified, written.acknowledged) == (7, True, True)
        assert 0 < written.took < 5
        fresh = await watched.gateway.fresh(tag(watched, "recipe"), 0.0)
        assert fresh.value == 7


@pytest.mark.parametrize("value", [0, 41, 1.5, "AB", True])
async def test_a_bad_value_is_never_sent(tmp_path: Path, value: Any) -> None:
    async with running(made(tmp_path)) as watched:
        await watched.until_good("mixer/recipe")
        with pytest.raises(BadValue):
            await watched.gateway.write(tag(watched, "recipe"), value)
        [line] = watched.gateway.lines
        assert line.engine.devices[0].record.writes == 0


async def test_a_write_to_a_line_that_is_not_open_fails_at_once(tmp_path: Path) -> None:
    watched = made(tmp_path)
    with pytest.raises(LineDown):
        await watched.gateway.write(tag(watched, "recipe"), 7)


async def test_a_disabled_device_is_never_spoken_to(tmp_path: Path) -> None:
    async with running(made(tmp_path, enabled=False)) as watched:
        gateway = watched.gateway
        assert {gateway.sample(tag(watched, name)).reason for name in TAGS} == {Reason.DISABLED}
        with pytest.raises(Offline, match="device mixer is disabled"):
            await gateway.write(tag(watched, "recipe"), 7)
        assert (await gateway.fresh(tag(watched, "speed"), 0.0)).reason is Reason.DISABLED
        assert [line.engine.devices for line in gateway.lines] == [[]]


async def test_a_fresh_value_is_read_now(tmp_path: Path) -> None:
    async with running(made(tmp_path, every="1h")) as watched:
        await watched.until_good("mixer/speed")
        known = watched.gateway.sample(tag(watched, "speed"))
        assert await watched.gateway.fresh(tag(watched, "speed"), 3600.0) is known
        before = time.time_ns()
        fresh = await watched.gateway.fresh(tag(watched, "speed"), 0.0)
        assert (fresh.quality, fresh.time > known.time) == (Quality.GOOD, True)
        assert fresh.time >= before


async def test_simultaneous_askers_share_one_exchange(tmp_path: Path) -> None:
    async with running(made(tmp_path, every="1h")) as watched:
        await watched.until_good(*(f"mixer/{name}" for name in TAGS))
        [device] = watched.gateway.lines[0].engine.devices
        before = device.record.exchanges
        speed = tag(watched, "speed")
        samples = await asyncio.gather(*(watched.gateway.fresh(speed, 0.0) for _ in range(50)))
        assert len({sample.time for sample in samples}) == 1
        assert device.record.exchanges == before + 1


async def test_a_fresh_value_of_a_line_that_is_not_open_is_what_is_known(tmp_path: Path) -> None:
    watched = made(tmp_path)
    sample = await watched.gateway.fresh(tag(watched, "speed"), 0.0)
    assert (sample.value, sample.quality) == (None, Quality.BAD)


@asynccontextmanager
async def slow_line(
    folder: Path, every: str = "1s"
) -> AsyncIterator[tuple[Watched, Unruly, Bench]]:
    """One station that looks at its memory at once and takes 0.4 s to answer."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}}, reply_timeout="2s")}
    path = write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", lines, defaults={"every": every})
    station, bench = Unruly(VigorStation(1), late=lambda _: 0.4), Bench()
    opened = partial(bench.open, [station], WIRE)
    async with running(Watched(Gateway(load(path), open_line=lambda _: opened))) as watched:
        await watched.until_good("mixer/speed")
        yield watched, station, bench


async def asked(station: Unruly) -> None:
    """Until the next question has arrived there, which is answered by what it held then."""
    before = len(station.heard)
    while len(station.heard) == before:
        await asyncio.sleep(0.001)


@pytest.mark.parametrize("max_age", [0.0, 0.1])
@on_virtual_time
async def test_a_reading_that_had_begun_before_the_question_is_no_answer(
    tmp_path: Path, max_age: float
) -> None:
    async with slow_line(tmp_path) as (watched, station, _):
        await asked(station)
        station.memory.write("D", 10, [4711])
        fresh = await watched.gateway.fresh(tag(watched, "speed"), max_age)
        assert fresh.value == 4711


@on_virtual_time
async def test_a_value_that_came_this_moment_is_not_younger_than_0_s(tmp_path: Path) -> None:
    async with slow_line(tmp_path, every="1h") as (watched, station, _):
        for value in (1, 2, 3):
            station.memory.write("D", 10, [value])
            assert (await watched.gateway.fresh(tag(watched, "speed"), 0.0)).value == value


@on_virtual_time
async def test_who_waits_for_a_reading_hears_at_once_that_there_will_be_none(
    tmp_path: Path,
) -> None:
    async with slow_line(tmp_path) as (watched, station, bench):
        await asked(station)
        asking = asyncio.create_task(watched.gateway.fresh(tag(watched, "speed"), 0.0))
        await asyncio.sleep(0)
        bench.vanish()
        since = asyncio.get_running_loop().time()
        assert (await asking).reason is Reason.LINE_DOWN
        assert asyncio.get_running_loop().time() - since < FRESH_WITHIN / 2


@on_virtual_time
async def test_where_the_clock_does_not_tell_which_reading_it_was_another_follows(
    tmp_path: Path,
) -> None:
    """Clocks with ticks of 15 ms are about."""
    watched = made(tmp_path)
    gateway, speed, expedited = watched.gateway, tag(watched, "speed"), list[Tag]()
    [line] = gateway.lines
    [poll] = [
        p for p in line.engine.schedule.polls(line.engine.devices[0]) if speed in p.block.tags
    ]
    line.engine.is_open = True
    # Only the call counts here: no line runs.
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
async def test_what_comes_unasked_is_answered_as_it_is_known_at_once(tmp_path: Path) -> None:
    reader = {
        "protocol": "frames",
        "framing": {"header": "<STX>", "terminator": "<ETX>"},
        "listen": {"scan": {"match": "(?P<code>[0-9]+)", "fields": {"code": {"type": "text"}}}},
        "tags": {"code": {"address": "code", "event": True}},
    }
    lines = {"door": {"port": "COM1", "devices": {"reader": reader}}}
    path = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)
    ears: list[Receiver] = []

    class Mute:
        async def close(self) -> None:
            pass

    async def opened(ear: Receiver) -> Any:
        ears.append(ear)
        return Mute()

    async with running(Watched(Gateway(load(path), open_line=lambda _: opened))) as watched:
        await asyncio.sleep(1)
        gateway, since = watched.gateway, asyncio.get_running_loop().time()
        code = gateway.tag("reader/code")
        assert code is not None
        assert (await gateway.fresh(code, 0.0)).reason is Reason.STARTING
        ears[0].received(b"\x024006381333931\x03")
        for max_age in (0.0, 60.0):
            assert (await gateway.fresh(code, max_age)).value == "4006381333931"
        assert asyncio.get_running_loop().time() == since


def test_what_moved_within_its_deadband_and_is_published_again_is_news_to_all(
    tmp_path: Path,
) -> None:
    """History too, which would be farther off than the deadband from then on."""
    lines = {"hall": vigor_line("simulator", {"level": {"address": "D10", "deadband": 5}})}
    path = write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", lines)
    watched = Watched(Gateway(load(path)))
    gateway, level = watched.gateway, tag(watched, "level")
    told = watched.told
    for value in (100, 104):
        gateway.samples([good(level, value, time.time_ns())])
    assert [sample.value for sample in told] == [100]
    for _ in range(2):
        gateway.mark_published([gateway.sample(level)])
    assert [sample.value for sample in told] == [100, 104]
    gateway.samples([good(level, 96, time.time_ns())])
    assert [sample.value for sample in told] == [100, 104, 96]


def test_zenoh_gets_the_files_settings(tmp_path: Path) -> None:
    watched = made(tmp_path)
    settings = watched.gateway.config.zenoh
    assert (settings.prefix, settings.mode) == ("plant", ZenohMode.PEER)
    assert settings.listen == ("tcp/127.0.0.1:7447",)


def test_the_plan_is_that_of_the_running_lines(tmp_path: Path) -> None:
    watched = made(tmp_path)
    [expected] = forecasts(watched.gateway.config)
    [line] = watched.gateway.lines
    assert [row.block.span for row in expected.blocks] == [
        block.span for device in line.engine.devices for block in device.blocks
    ]
