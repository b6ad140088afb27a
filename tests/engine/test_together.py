"""A device that loses requests sent together gets one at a time."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Idle, Poll, Probe, Resynced, Settle, Settled, Traffic
from gateway.engine.results.pipelining import PROOFS, TRY_AGAIN
from gateway.protocols.modbus.drivers import ModbusTcp
from tests.engine.rig import REPLIED, SILENCE, Rig, tcp_device
from tests.engine.test_change import change
from tests.sim.bench import WIRE


def busy_device() -> Device:
    """Its blocks are always due together."""
    plain = tcp_device().settings
    tags = tuple(replace(tag, every=0.002) for tag in plain.tags)
    return Device(replace(plain, tags=tags), WIRE)


# By the poll, its place in the transaction, and the number of polls in it.
Answers = Callable[[Poll, int, int], bool]


def transactions(rig: Rig, seconds: float, answers: Answers) -> list[int]:
    """Runs the line. Returns how many polls each transaction had."""
    sizes, end = [], rig.now + seconds
    while rig.now < end:
        job = rig.next()
        match job:
            case Idle(until=until):
                rig.now = until
            case Probe():
                rig.conclude(job, Resynced(1000))
            case Settle():
                rig.conclude(job, Settled(None))
            case Poll():
                polls = [job, *rig.engine.alongside(job, rig.now)]
                sizes.append(len(polls))
                for place, poll in enumerate(polls):
                    is_answered = answers(poll, place, len(polls))
                    units = (0,) * poll.block.span.size if is_answered else SILENCE
                    traffic = REPLIED if poll is polls[-1] else Traffic()
                    rig.conclude(poll, units, traffic, took=0.002)
    return sizes


def first_only(_poll: Poll, place: int, _of: int) -> bool:
    return place == 0


def every_one(_poll: Poll, _place: int, _of: int) -> bool:
    return True


def alone(_poll: Poll, _place: int, of: int) -> bool:
    return of == 1


def reduced(rig: Rig) -> int:
    return sum(log.event == "window reduced" for log in rig.logged)


def test_a_device_that_replies_to_the_first_gets_one_at_a_time_and_says_so() -> None:
    rig = Rig(busy_device())
    sizes = transactions(rig, 5.0, first_only)
    assert PROOFS <= sum(size > 1 for size in sizes) <= 3 * PROOFS
    assert max(sizes[-1000:]) == 1
    assert reduced(rig) == 1
    assert rig.device.diagnosis() == "It takes one request at a time, not 4: set `window: 1`"


def test_it_is_tried_again_after_an_hour_once() -> None:
    rig = Rig(busy_device())
    transactions(rig, 5.0, first_only)
    for _ in range(2):
        rig.now += TRY_AGAIN
        sizes = transactions(rig, 5.0, first_only)
        assert sum(size > 1 for size in sizes) == 1
    assert reduced(rig) == 1
    rig.now += TRY_AGAIN
    sizes = transactions(rig, 5.0, every_one)
    assert max(sizes) == 4
    assert rig.device.diagnosis() == ""


def test_a_device_with_other_settings_gets_one_at_a_time_as_before() -> None:
    """After each reload requests went together, and were lost (`hostile` seed 2700042)."""
    rig = Rig(busy_device())
    transactions(rig, 5.0, first_only)
    change(rig, rig.device, late_guard=0.7)
    assert max(transactions(rig, 5.0, first_only)) == 1


def test_a_block_that_is_never_answered_costs_no_window() -> None:
    rig = Rig(busy_device())
    silent = rig.device.blocks[2].span
    sizes = transactions(rig, 20.0, lambda poll, _place, _of: poll.block.span != silent)
    assert reduced(rig) == 0
    assert max(sizes[-50:]) == 4


def test_single_losses_cost_no_window() -> None:
    rig, count = Rig(busy_device()), 0

    def seldom(_poll: Poll, _place: int, _of: int) -> bool:
        nonlocal count
        count += 1
        return count % 50 != 0

    sizes = transactions(rig, 20.0, seldom)
    assert reduced(rig) == 0
    assert max(sizes[-50:]) == 4


def test_requests_lost_together_are_sent_alone_also_after_the_device_was_offline() -> None:
    """Behind a bridge with a time-out of its own each burst made the device offline again."""
    plain = busy_device().settings
    rig = Rig(Device(replace(plain, timing=replace(plain.timing, retries=0)), WIRE))
    sizes = transactions(rig, 60.0, alone)
    assert sum(size > 1 for size in sizes) <= 2 * PROOFS
    assert reduced(rig) == 1


@pytest.mark.parametrize("answers", [first_only, alone])
@pytest.mark.parametrize("window", [2, 4])
def test_a_device_that_one_loss_takes_offline_gets_one_at_a_time_too(
    answers: Answers, window: int
) -> None:
    plain = busy_device().settings
    timing = replace(plain.timing, retries=0)
    driver = ModbusTcp(station=1, window=window)
    rig = Rig(Device(replace(plain, driver=driver, timing=timing), WIRE))
    sizes = transactions(rig, 60.0, answers)
    assert sum(size > 1 for size in sizes) <= 2 * PROOFS
    assert reduced(rig) == 1
    assert max(sizes[-1000:]) == 1
