"""The ages that `check` promises, compared with the schedule on random lines."""

import random

import pytest

from gateway.engine.device.ages import load_of, polled_blocks, worst_ages
from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Idle
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.jobs.requests import Write
from gateway.engine.schedule.schedule import Schedule
from gateway.tags import WriteRule
from tests.sim.plant import device, make_tag

A_WRITE = 0.03  # seconds of the wire
COUNTS, INTERVALS = (1, 1, 3, 10, 30), (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def answering(station: int, *intervals: float) -> Device:
    """One block of one word for each interval."""
    tags = [
        make_tag(f"D{66 * n}", every=every, write=WriteRule()) for n, every in enumerate(intervals)
    ]
    found = device(tags, station=station)
    found.health.answered()
    return found


def random_devices(chance: random.Random) -> list[Device]:
    def intervals() -> list[float]:
        groups = chance.choice((1, 1, 2, 3))
        return [
            every
            for _ in range(groups)
            for every in [chance.choice(INTERVALS)] * chance.choice(COUNTS)
        ]

    return [answering(n + 1, *intervals()) for n in range(chance.choice((1, 2, 3, 5, 8)))]


def ages(
    devices: list[Device], seconds: float, written: Device | None = None
) -> dict[PollEntry, float]:
    """The worst age of each poll, in planned wire times. `written`: all the time."""
    schedule, now, worst = Schedule(devices, 0.0), 0.0, dict[PollEntry, float]()
    while now < seconds:
        if written is not None and not schedule.requests.waiting:
            schedule.requests.submit(Write(written, written.tags[0], [1], now))
        match schedule.next(now):
            case PollEntry(device=of) as poll:
                begun, before = now, poll.reads.at
                now += of.seconds(poll.block.cost)
                if before is not None and before > seconds / 10:  # all have found their places
                    worst[poll] = max(worst.get(poll, 0.0), now - before)
                poll.reads.at = now
                schedule.polled(poll, now)
                of.used(now, begun)
            case Write():
                now += A_WRITE
            case Idle(until):
                now = until if written is None else now + 0.001
    polls = [poll for device in devices for poll in schedule.polls(device)]
    return {poll: worst.get(poll, now - (poll.reads.at or 0.0)) for poll in polls}


def over(found: dict[PollEntry, float]) -> float:
    """The worst age as a share of the promised one."""
    blocks = polled_blocks([*dict.fromkeys(poll.device for poll in found)])
    promised = dict(zip([(b.device, b.block) for b in blocks], worst_ages(blocks), strict=True))
    return max(age / promised[poll.device, poll.block] for poll, age in found.items())


@pytest.mark.parametrize("seed", range(12))
def test_no_value_gets_older_than_promised(seed: int) -> None:
    devices = random_devices(random.Random(seed))
    overloaded = load_of(polled_blocks(devices)) > 1
    assert over(ages(devices, 120.0)) <= (1.25 if overloaded else 1.0)


def test_the_longer_wait_of_a_big_device_among_small_ones_is_promised() -> None:
    """All have the same share of the wire, and it needs ten times what the others need."""
    small = [answering(n, *[0.5] * 10) for n in range(1, 10)]
    big = answering(10, *[0.5] * 100)
    found = ages([*small, big], 300.0)
    assert over(found) <= 1.0
    by_device = {
        one: [age for p, age in found.items() if p.device is one] for one in (small[0], big)
    }
    assert min(by_device[big]) > 20.0
    assert max(by_device[small[0]]) < 3.0


def test_a_device_that_is_written_all_the_time_is_polled_like_the_others() -> None:
    devices = [answering(n, *[0.5] * 20) for n in (1, 2, 3)]
    found = ages(devices, 300.0, written=devices[0])
    worst = [max(age for poll, age in found.items() if poll.device is one) for one in devices]
    assert max(worst) < 1.1 * min(worst)
    assert max(worst) < 4.0  # without the writes 1.5: they take half of the wire


def test_intervals_of_one_device_wait_alike() -> None:
    """By earliest deadline the slow ones are not stretched as the fast ones are."""
    [fast, slow] = worst_ages(polled_blocks([answering(1, *[0.1] * 10, *[10.0] * 100)]))[::109]
    assert fast > 0.3
    assert slow - fast == pytest.approx(2 * (10.0 - 0.1))


def test_what_programs_at_a_door_take_is_part_of_the_load() -> None:
    blocks = polled_blocks([answering(1, 0.2)])
    [block] = blocks
    others = 1.1 - load_of(blocks)
    [age] = worst_ages(blocks, others)
    assert age == pytest.approx(2 * block.block.every + 2 * block.seconds)  # as an overloaded line
    [unhurried] = worst_ages(blocks, others / 10)
    assert unhurried < age
