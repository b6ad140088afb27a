"""Losses: the values that a full link may have dropped, and when they are put again."""

import pytest

from gateway.northbound.publishing.slow_puts import ROUNDS, SlowPuts

SPEED, LEVEL = "plant/mixer/speed", "plant/mixer/level"
LIMIT = 0.05


@pytest.fixture
def losses() -> SlowPuts:
    return SlowPuts(LIMIT)


def test_quick_puts_are_not_put_again(losses: SlowPuts) -> None:
    losses.sent([SPEED], 0.9 * LIMIT, 100.0)
    assert losses.congested == 0
    assert losses.due(1000.0) == []


def test_a_slow_put_and_those_after_it_are_put_again_in_rounds(losses: SlowPuts) -> None:
    losses.sent([LEVEL], LIMIT, 100.0)
    losses.sent([SPEED], 0.0, 100.5)  # a full link drops it at once
    assert losses.congested == 1
    assert losses.due(100.9) == []
    for pause in ROUNDS:
        assert losses.due(100.0 + pause - 0.01) == []
        assert losses.due(100.0 + pause) == [LEVEL, SPEED]
    assert losses.due(1000.0) == []


def test_the_next_slow_put_starts_the_rounds_again(losses: SlowPuts) -> None:
    losses.sent([LEVEL], LIMIT, 100.0)
    losses.due(101.0)
    losses.sent([SPEED], LIMIT, 101.5)
    assert losses.due(102.4) == []
    assert losses.due(102.5) == [LEVEL, SPEED]


def test_a_suspect_that_was_put_goes_behind_the_others(losses: SlowPuts) -> None:
    """A round that a slow put ended continues with the tags that it did not reach."""
    losses.sent([LEVEL, SPEED], LIMIT, 100.0)
    losses.sent([LEVEL], 0.0, 101.0)
    assert losses.due(101.0) == [SPEED, LEVEL]


def test_puts_long_after_the_last_slow_one_are_not_suspect(losses: SlowPuts) -> None:
    losses.sent([LEVEL], LIMIT, 100.0)
    losses.sent([SPEED], 0.0, 100.0 + ROUNDS[-1] + 0.1)
    assert losses.due(101.0) == [LEVEL]
