"""A value that is not read for too long turns bad, though its device answers."""

import asyncio
from collections.abc import Sequence

import pytest

from gateway.engine.device.ages import PolledBlock, polled_blocks, worst_ages
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Poll, Resynced
from gateway.engine.results import staleness
from gateway.engine.results.staleness import Staleness
from gateway.errors import NoReply
from gateway.tags import Quality, Reason
from tests.engine.rig import Rig, link_device
from tests.sim.plant import Plant, device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time


def scattered(count: int, station: int = 1, every: float = 0.5) -> Device:
    tags = [make_tag(f"D{66 * n}", every=every, device=f"plc{station}") for n in range(count)]
    return device(tags, station=station, reply_timeout=0.5)


def limit(line: Plant) -> float:
    """By the rule: twice the worst age promised, and what one failure takes."""
    return 2 * max(worst_ages(polled_blocks(line.line.engine.devices))) + 0.5 + 0.5


@on_virtual_time
async def test_values_turn_overdue_when_the_line_becomes_too_slow_for_them() -> None:
    """Its turnaround grows from 5 ms to 400 ms, which no time-out notices."""
    dev = scattered(10)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(20)
        assert line.good(dev)
        line.reported.clear()
        slow_since = asyncio.get_running_loop().time()
        line.stations[0].late = lambda _: 0.4
        most = limit(line)
        await asyncio.sleep(60)
        found = [(at, s) for at, s in line.reported if s.quality is Quality.BAD]
        assert {s.reason for _, s in found} == {Reason.OVERDUE}
        assert "not read for" in found[0][1].detail
        assert found[0][0] - slow_since < most + 0.5
        assert dev.record.overdue == len(found)
        # The turnaround is measured, so the limits grow with it.
        assert line.good(dev)
        assert found[-1][0] - slow_since < 40


@on_virtual_time
async def test_no_good_value_is_older_than_its_limit() -> None:
    """One device is written all the time, the other becomes slow."""
    dev, other = scattered(20), scattered(20, station=2)
    line = plant([dev, other])
    read_at = dict.fromkeys((*dev.tags, *other.tags), 0.0)
    async with running(line):
        await asyncio.sleep(20)
        most = limit(line)
        line.stations[0].late = lambda _: 0.3
        for _ in range(3000):
            if not line.line.engine.schedule.requests.waiting:
                line.submit(other, other.tags[0], 1)
            await asyncio.sleep(0.02)
            most = max(most, limit(line))  # it grows as the slow turnaround is measured
            read_at |= {sample.tag: at for at, sample in line.reported}
            line.reported.clear()
            now = asyncio.get_running_loop().time()
            good = [tag for tag in read_at if line.now[tag].quality is Quality.GOOD]
            assert all(now - read_at[tag] <= most for tag in good)
    assert dev.record.overdue > 0


@on_virtual_time
async def test_nothing_is_overdue_on_a_line_that_carries_its_load() -> None:
    dev, other = scattered(8), scattered(8, station=2)
    line = plant([dev, other])
    async with running(line):
        await asyncio.sleep(600)
    assert dev.record.overdue == other.record.overdue == 0
    bad = {s.reason for _, s in line.reported if s.quality is Quality.BAD}
    assert bad == set()


@on_virtual_time
async def test_a_device_that_is_written_all_the_time_is_polled_like_the_others() -> None:
    """The load is twice what the line carries, and half of the time goes to the writes."""
    devices = [scattered(20, station=n) for n in (1, 2, 3)]
    line = plant(devices)
    async with running(line):
        await asyncio.sleep(5)
        for _ in range(3000):
            if not line.line.engine.schedule.requests.waiting:
                line.submit(devices[0], devices[0].tags[0], 1)
            await asyncio.sleep(0.02)
    # A written tag is polled at once each time; no other device is left behind.
    reads = [
        min(poll.reads.count for poll in line.line.engine.schedule.polls(dev)) for dev in devices
    ]
    assert min(reads) > 0.6 * max(reads)


def expire(rig: Rig) -> Reason | None:
    """Lets the deadlines of a minute pass. Returns the reason of the last bad value."""
    until = rig.now + 60.0
    while rig.engine.deadline <= until:
        rig.now = rig.engine.deadline
        rig.note(rig.engine.expire(rig.now, rig.time))
    return rig.samples[-1].reason


def read(rig: Rig) -> None:
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, [0] * len(poll.block.tags))
    assert rig.samples[-1].reason is None


def test_values_that_all_turned_overdue_at_once_do_so_again() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    for _ in range(3):
        read(rig)
        assert expire(rig) is Reason.OVERDUE


def test_a_poll_that_fails_brings_the_deadline_of_its_values() -> None:
    rig = Rig()
    rig.bring(State.ONLINE)
    read(rig)
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    rig.conclude(poll, NoReply("no reply"))
    assert rig.engine.deadline <= rig.now + 2 * poll.block.every


@pytest.mark.parametrize("failing", [True, False])
def test_an_old_value_names_the_device_that_fails_and_the_log_says_it_once(failing: bool) -> None:
    rig = Rig(link_device(), link_device(station=2))
    for _ in rig.devices:
        rig.conclude(rig.transacted(), Resynced(1))
    for _ in rig.devices:
        rig.conclude(rig.transacted(), [1, 2, 3, 4, 5, 6])
    poll = rig.transacted()
    [other] = [one for one in rig.devices if one is not poll.device]
    if failing:
        rig.fail(poll)
        assert poll.device.health.state is State.FAILING
    rig.samples.clear()
    rig.now += 100.0
    rig.note(rig.engine.expire(rig.now, rig.time))
    details = {s.detail for s in rig.samples if s.reason is Reason.OVERDUE and s.tag in other.tags}
    assert len(details) == 1
    assert (f"{poll.device.name}, which fails" in details.pop()) == failing
    logged = [event for event in rig.logged if event.event == "block overdue"]
    assert ["others on the line" in str(event.fields) for event in logged] == [True] * (
        0 if failing else 2
    )


def test_ages_are_calculated_again_only_when_the_turnaround_changes_by_a_millisecond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A measured turnaround is a little different after each comparison."""
    found = list[float]()

    def counting(blocks: Sequence[PolledBlock]) -> list[float]:
        ages = worst_ages(blocks)
        found.append(ages[0])
        return ages

    monkeypatch.setattr(staleness, "worst_ages", counting)
    rig = Rig(link_device())
    rig.bring(State.ONLINE)
    read(rig)
    [rule] = [one for one in rig.engine.rules.all if isinstance(one, Staleness)]
    found.clear()
    for expected in (0.0101, 0.0108, 0.0104, 0.0121, 0.0119):
        rig.devices[0].turnaround.expected = expected
        rule.tick(rig.now, rig.time)
    assert len(found) == 3  # 11, 13 and 12 begun milliseconds
    assert found[1] > found[0]
