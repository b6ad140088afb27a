"""Requests that timed out on a connection with numbers, and the wait that they cost others."""

from typing import NamedTuple

import pytest

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.jobs.unanswered import (
    FIRST_WAIT,
    KEPT,
    LONGEST_WAIT,
    MARGIN,
    TimedOut,
    Unanswered,
)
from gateway.errors import NoReply
from gateway.protocols.modbus import ModbusTcp
from tests.line.slaves import NETWORK, registers, slave


class Frame(NamedTuple):
    transaction: int
    error: bool = False


def answers(frame: Frame) -> bool:
    if frame.error:
        raise NoReply("exception 0B")
    return True


def unit(station: int, state: State) -> Device:
    driver = ModbusTcp(station=station)
    device = slave(driver, registers(driver, 1), wire=NETWORK)
    if state is State.ONLINE:
        device.health.answered()
    assert device.state is state
    return device


ALIVE, DEAD = 1, 2


@pytest.fixture
def alive() -> Device:
    return unit(ALIVE, State.ONLINE)


@pytest.fixture
def dead() -> Device:
    return unit(DEAD, State.STARTING)


def after_one(dead: Device, sent: float = 10.0) -> Unanswered:
    unanswered = Unanswered()
    unanswered.requests.append(TimedOut(dead, 7, answers, sent))
    return unanswered


def test_a_request_to_another_unit_waits_for_the_one_before_it(alive: Device, dead: Device) -> None:
    unanswered = after_one(dead)
    assert unanswered.held_up_until(alive) == 10.0 + FIRST_WAIT
    assert unanswered.held_up_until(dead) == 0.0


def test_a_device_that_failed_waits_no_longer(alive: Device, dead: Device) -> None:
    alive.health.unclear(NoReply("no reply"), None, 10.5)
    assert after_one(dead).held_up_until(alive) == 0.0


def test_an_answer_shows_that_older_requests_hold_up_nothing(alive: Device, dead: Device) -> None:
    unanswered = after_one(dead)
    unanswered.answered(11.0, 14.0)
    assert unanswered.held_up_until(alive) == 0.0
    assert unanswered.longest == 4.0
    assert unanswered.take(Frame(7), 14.5)  # its number stays known
    again = TimedOut(dead, 8, answers, 20.0)
    unanswered.requests.append(again)
    assert unanswered.held_up_until(alive) == 20.0 + 4.0 * MARGIN


def test_a_long_wait_has_an_end(alive: Device, dead: Device) -> None:
    unanswered = after_one(dead)
    unanswered.answered(11.0, 60.0)
    unanswered.requests.append(TimedOut(dead, 8, answers, 200.0))
    assert unanswered.held_up_until(alive) == 200.0 + LONGEST_WAIT


@pytest.mark.parametrize("error", [True, False], ids=["0B", "reply"])
def test_a_late_answer_counts_for_its_own_device(alive: Device, dead: Device, error: bool) -> None:
    unanswered = after_one(dead)
    assert not unanswered.take(Frame(6, error), 12.0)
    assert unanswered.take(Frame(7, error), 12.0)
    assert not unanswered.take(Frame(7, error), 12.0)
    assert (dead.record.late, alive.record.late) == (1, 0)
    assert dead.state is State.STARTING
    assert (dead.health.trouble is None) is error
    assert unanswered.held_up_until(alive) == 0.0


def test_a_late_reply_of_an_offline_device_has_it_probed_at_once(dead: Device) -> None:
    for _ in range(4):
        dead.health.gave_up(11.0, 1.0)
    assert dead.health.probes.due > 12.0
    after_one(dead).take(Frame(7), 12.0)
    assert dead.health.probes.due == 12.0


def test_a_request_is_forgotten_after_a_minute(dead: Device) -> None:
    unanswered = after_one(dead)
    unanswered.answered(11.0, 10.1 + KEPT)
    assert not unanswered.requests
    assert unanswered.longest == 0.0


def test_the_late_answer_of_the_last_request_counts_once(dead: Device) -> None:
    unanswered = after_one(dead)
    unanswered.forget(Frame(7))
    assert not unanswered.requests
    assert dead.record.late == 0
