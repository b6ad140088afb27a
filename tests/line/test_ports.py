"""Lost ports and driver bugs: they end one line for a while, and no other."""

import asyncio
import itertools
import random
from typing import Any

import pytest
from structlog.testing import capture_logs

from gateway.errors import Unclear
from gateway.line.opening import REOPEN_LONGEST
from gateway.protocols.vigor import Vigor
from gateway.tags import Quality, Reason, WriteRule
from tests.line.clocks import clocks, wind_up
from tests.sim.plant import device, make_tag, plant, running, words
from tests.sim.virtual import now, on_virtual_time


@on_virtual_time
async def test_every_tag_turns_bad_at_port_loss_and_good_after_it() -> None:
    devices = [clocks(10, 10, station=n) for n in (1, 2)]
    line = plant(devices)
    wind_up(line)
    chance = random.Random(3)
    async with running(line):
        for _ in range(20):
            await asyncio.sleep(11 + chance.random())
            gone = now()
            line.bench.vanish()
            await asyncio.sleep(0.001)
            for dev in devices:
                for tag in dev.tags:
                    assert line.reason(tag) is Reason.LINE_DOWN
            assert line.turned(devices[0].tags[0], Quality.BAD, gone) - gone < 0.001
            line.bench.come_back()
            await asyncio.sleep(2)
            assert all(line.good(dev) for dev in devices)


@on_virtual_time
async def test_port_loss_after_a_time_out_is_reported_at_once() -> None:
    dev = clocks(10, guard=20.0)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].mute = True
        await asyncio.sleep(3)  # in the guard now
        line.bench.vanish()
        await asyncio.sleep(0.001)
        assert line.reason(dev.tags[0]) is Reason.LINE_DOWN


@on_virtual_time
async def test_the_pause_between_tries_grows_to_ten_seconds_at_every_loss() -> None:
    line = plant([clocks(10)])
    async with running(line):
        await asyncio.sleep(60)
        for _ in range(2):
            line.bench.opened.clear()
            line.bench.vanish()
            await asyncio.sleep(300)
            tries = line.bench.opened
            pauses = [b - a for a, b in itertools.pairwise(tries)]
            assert 0.15 < pauses[0] < 0.5
            assert all(0.8 * 10 <= pause <= 1.2 * 10 + 0.01 for pause in pauses[8:])
            assert len({round(pause, 6) for pause in pauses[8:]}) > 5  # jitter
            line.bench.come_back()
            await asyncio.sleep(REOPEN_LONGEST * 3)
            assert line.line.engine.is_open


@on_virtual_time
async def test_a_missing_port_is_warned_of_once_and_not_at_every_try() -> None:
    line = plant([clocks(5)])
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(10)
            for _ in range(2):
                line.bench.vanish()
                await asyncio.sleep(300)
                line.bench.come_back()
                await asyncio.sleep(REOPEN_LONGEST * 3)
    down = [entry["why"] for entry in logs if entry["event"] == "line down"]
    warned = [e["why"] for e in logs if e["event"] == "line down" and e["log_level"] == "warning"]
    assert len(down) > 40
    assert warned == ["unplugged", "unplugged"]  # once for each time it went


@on_virtual_time
async def test_a_driver_bug_takes_down_its_own_line_only(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken, sound = plant([clocks(10)]), plant([clocks(10)])
    read, bugs = Vigor.read, 3

    async def buggy(self: Vigor, talk: Any, span: Any) -> Any:
        nonlocal bugs
        if self is broken.devices[0].driver and bugs:
            bugs -= 1
            raise ZeroDivisionError("a bug")
        return await read(self, talk, span)

    monkeypatch.setattr(Vigor, "read", buggy)
    async with running(broken), running(sound):
        await asyncio.sleep(0.3)
        assert "ZeroDivisionError" in broken.line.engine.record.trouble
        assert broken.reason(broken.devices[0].tags[0]) is Reason.LINE_DOWN
        await asyncio.sleep(10)
        assert broken.good(broken.devices[0])
        assert sound.line.engine.record.opened == 1


@on_virtual_time
async def test_a_driver_bug_during_a_write_ends_it_unclear(monkeypatch: pytest.MonkeyPatch) -> None:
    tag = make_tag("D0", write=WriteRule())
    line = plant([device([tag])])

    async def buggy(self: Vigor, talk: Any, span: Any, units: Any) -> bool:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Vigor, "write", buggy)
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], tag, 1)
        await asyncio.sleep(5)
        assert isinstance(outcome.once, Unclear)
        assert line.good(line.devices[0])


@on_virtual_time
async def test_the_port_is_closed_at_its_loss_and_at_the_end_of_the_line() -> None:
    line = plant([clocks(5)])
    async with running(line):
        await asyncio.sleep(2)
        assert line.bench.inner is not None
        line.bench.vanish()
        await asyncio.sleep(0.001)
        assert line.bench.inner is None
        line.bench.come_back()
        await asyncio.sleep(REOPEN_LONGEST * 2)
        assert line.line.engine.is_open
    assert line.bench.inner is None


@on_virtual_time
async def test_bytes_during_the_silence_before_a_request_belong_to_no_transaction() -> None:
    dev = device(words(0, 1, every=0.001), silence=0.1)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(3)
        reads = len(line.reported)
        while len(line.reported) == reads:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.05)  # the next poll waits for its silence
        before = line.line.engine.record.unasked
        line.bench.received(b"\x55\x55")
        assert line.line.engine.record.unasked == before + 2
