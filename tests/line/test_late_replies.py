"""Late replies on a line: no wrong value, no false acknowledgement."""

import asyncio
import random

import pytest

from gateway.engine.device.health import State
from gateway.engine.engine import Engine
from gateway.engine.jobs.jobs import Probe, Settle
from gateway.errors import Busy, Offline, Unclear
from gateway.tags import WriteResult, WriteRule
from tests.line.clocks import clocks, wind_up
from tests.sim.plant import device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time
from tests.sim.witness import Witness


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("sizes", [(10, 10, 10), (5, 9, 14)])
@pytest.mark.parametrize("most", [0.15, 1.2])  # seconds beyond the time-out; the guard is 0.3
@pytest.mark.parametrize("turnaround_known", [True, False])
@on_virtual_time
async def test_late_replies_never_make_a_wrong_value(
    share: float, sizes: tuple[int, ...], most: float, turnaround_known: bool
) -> None:
    timeout = 0.3

    def late(chance: random.Random) -> float:
        if chance.random() < share:
            return timeout + chance.uniform(0.05, most)
        return 0.0 if turnaround_known else chance.uniform(0.0, timeout / 2)

    devices = [
        clocks(*sizes, station=n, every=0.2, guard=0.3, reply_timeout=timeout) for n in (1, 2)
    ]
    line = plant(devices, seed=int(share * 100))
    wind_up(line)
    for station in line.stations:
        station.late = late
    witness = Witness(line)
    async with running(line):
        for _ in range(60):
            await asyncio.sleep(120)
            if witness.right >= 10_000:
                break
    assert witness.wrong == []
    assert witness.right >= 10_000
    assert sum(d.record.late for d in devices) > 20


@on_virtual_time
async def test_a_late_reply_within_the_guard_is_awaited_and_counted() -> None:
    dev = clocks(10, reply_timeout=0.3, guard=0.5)
    line = plant([dev])
    wind_up(line)
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].late = lambda _: 0.4
        await asyncio.sleep(5)
        assert dev.record.late >= 3
        assert dev.state is State.OFFLINE
        assert "raise reply_timeout" in dev.diagnosis()
        await asyncio.sleep(60)
        assert "raise reply_timeout" in dev.diagnosis()  # probes do not wait for it any more


@pytest.mark.parametrize("late_acks", [0.1, 0.4])
@on_virtual_time
async def test_a_late_acknowledgement_never_confirms_another_write(late_acks: float) -> None:
    """A write is done only when the memory holds its value; no value is sent twice."""
    dev = device(
        [make_tag(f"D{n}", write=WriteRule(), every=0.5) for n in range(4)],
        reply_timeout=0.2,
        guard=0.15,
    )
    line = plant([dev])
    station = line.stations[0]
    done: list[int] = []

    def late(chance: random.Random) -> float:
        return 0.2 + chance.uniform(0.05, 0.3) if chance.random() < late_acks else 0.0

    station.late = late
    async with running(line):
        await asyncio.sleep(1)
        for value in range(1, 1500):
            tag = dev.tags[value % 4]
            # A deaf station does not write.
            deaf = value % 5 == 0
            if deaf:
                station.answer = lambda data, now: []
            outcome = line.submit(dev, tag, value)
            while not outcome.outcomes:
                await asyncio.sleep(0.01)
            station.answer = None
            held = station.memory.read("D", tag.address.number)[0]
            match outcome.once:
                case WriteResult():
                    assert held == value
                    done.append(value)
                case Offline() | Busy():
                    assert held != value
                case Unclear():
                    pass
                case other:
                    raise AssertionError(other)
    sent = [data for _, data in line.writes_sent()]
    assert len(done) > 300
    assert len(sent) == len(set(sent))  # every write had its own value


@on_virtual_time
async def test_a_line_that_waits_for_quiet_without_end_falls_and_opens_again() -> None:
    """An engine error: the wait takes no time, so no other line would get its turn."""
    line = plant([clocks(10)])
    engine = line.line.engine
    async with running(line):
        await asyncio.sleep(2)
        settle = Settle(line.devices[0], 0.0, 0.0, Probe(line.devices[0], None, 1))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Engine, "next", lambda *_: settle)
            patch.setattr(Engine, "conclude", lambda *_: [])
            await asyncio.sleep(0.2)
        assert "waits for quiet without end" in engine.record.trouble
        await asyncio.sleep(5)
        assert line.good(line.devices[0])
