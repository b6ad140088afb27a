"""A peer may send what a wire carries, what it kept during a stall, and replies; no more."""

import pytest

from gateway.transport.stream import MOST_AT_ONCE, PER_REQUEST, SLOWEST_RATE, Allowance


def too_many(allowance: Allowance, rate: float, seconds: float, *, requests: bool = False) -> bool:
    """Receives at this rate, in pieces of 10 ms; `requests`: with a request before each piece."""
    for piece in range(int(seconds * 100)):
        if requests:
            allowance.requested()
        if allowance.received(int(rate / 100), 100.0 + piece / 100):
            return True
    return False


@pytest.mark.parametrize("baudrate", [0, 9600, 115200, 921600])
def test_four_times_the_wire_is_allowed_and_much_more_is_not(baudrate: int) -> None:
    most = max(SLOWEST_RATE, 0.4 * baudrate)
    assert not too_many(Allowance(baudrate), most, 60.0)
    assert too_many(Allowance(baudrate), 1.5 * most, 60.0)


def test_a_burst_after_a_stall_is_allowed_again_and_again() -> None:
    allowance = Allowance(9600)
    for stall in range(10):
        assert not allowance.received(MOST_AT_ONCE, 60.0 * stall)


def test_one_burst_that_is_too_long_is_not() -> None:
    rate = Allowance(9600).received(MOST_AT_ONCE + 1, 100.0)
    assert rate == pytest.approx(100 * MOST_AT_ONCE, rel=0.01)  # in a time too short to measure


def test_a_network_device_may_reply_faster_than_any_wire() -> None:
    """3,000 replies of 260 bytes a second; without the requests it would be a flood."""
    rate = 3000 * 260
    assert not too_many(Allowance(0), min(rate, 100 * PER_REQUEST), 10.0, requests=True)
    assert too_many(Allowance(0), rate, 10.0)


def test_requests_are_not_saved_up() -> None:
    allowance = Allowance(0)
    for _ in range(1000):
        allowance.requested()
    assert allowance.received(MOST_AT_ONCE + 1, 100.0)
