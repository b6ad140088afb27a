"""One transfer: when it writes, what it carries, and its state."""

from itertools import pairwise
from typing import Any

import pytest

from gateway.errors import (
    BadValue,
    Busy,
    Garbled,
    GatewayError,
    LineDown,
    NoReply,
    Offline,
    Refusal,
    Refused,
    Superseded,
    Unclear,
)
from gateway.parts.transfers.codes import DONE, Code, End, outcome_of
from gateway.parts.transfers.transfer_row import Carry, SourceReading, State, TransferRow
from gateway.tags import Reason
from gateway.tags.transfer import TransferRule
from gateway.values import Value

BAD = SourceReading(None, float("inf"), Reason.NO_REPLY)
NOT_DONE = outcome_of(Offline("mixer is offline"))
UNCLEAR = outcome_of(NoReply("no reply"))


def rule(**settings: Any) -> TransferRule:
    names = {"source": "a/x", "target": "b/y", "text": ("a/x", "b/y")}
    return TransferRule(number=1, **{**names, **settings})


def row(**settings: Any) -> TransferRow:
    return TransferRow(rule(**settings), 0.0)


def good(value: Value, age: float = 0.0) -> SourceReading:
    return SourceReading(value, age)


def carried(one: TransferRow, value: Value, now: float, *, age: float = 0.0) -> Carry | None:
    """The source is published with this value, and the row looks."""
    one.changed(value)
    return one.next(good(value, age), now)


def test_each_new_value_is_carried_once() -> None:
    one = row()
    assert carried(one, 5, 1.0) == Carry(5, within=5.0)
    one.ended(DONE, 1.1)
    assert one.next(good(5), 1.2) is None
    assert carried(one, 5, 2.0) is None
    assert carried(one, 6, 3.0) == Carry(6, within=5.0)
    assert one.counts[End.DONE] == 1


def test_a_value_that_an_earlier_read_brought_waits_for_the_interval_of_the_source() -> None:
    """The write reads the block of its target, and the source may be in it: no end otherwise."""
    one = row(read_every=2.0)
    assert carried(one, 1, 1.0) is not None
    one.ended(DONE, 1.1)
    assert carried(one, 2, 1.2) is None
    assert one.wake(2.5) == 3.0
    assert one.next(good(2), 3.0) == Carry(2, within=5.0)
    one.ended(NOT_DONE, 3.1)
    assert one.next(good(2), 3.6) == Carry(2, within=5.0)  # tried again, as ever
    one.ended(NOT_DONE, 3.7)
    one.target_online(3.8)
    assert one.next(good(2), 3.8) == Carry(2, within=5.0)
    one.ended(DONE, 3.9)
    assert carried(one, 2, 5.0) is None  # as the target has it
    assert carried(one, 3, 5.8) == Carry(3, within=5.0)


def test_only_the_newest_value_waits_while_a_write_is_under_way() -> None:
    one = row()
    assert carried(one, 1, 1.0) is not None
    assert carried(one, 2, 1.1) is None
    assert carried(one, 3, 1.2) is None
    one.ended(DONE, 1.3)
    assert one.next(good(3), 1.3) == Carry(3, within=5.0)
    one.ended(DONE, 1.4)
    assert one.next(good(3), 1.5) is None


def test_a_value_that_the_target_has_again_is_not_carried() -> None:
    one = row()
    assert carried(one, 1, 1.0) is not None
    assert [carried(one, value, 1.1) for value in (2, 1)] == [None, None]
    one.ended(DONE, 1.3)
    assert one.next(good(1), 1.3) is None


@pytest.mark.parametrize("age", [5.0, 60.0])
def test_a_value_that_was_read_too_long_ago_is_not_carried(age: float) -> None:
    one = row()
    assert carried(one, 5, 1.0, age=age) is None
    assert one.verdict(good(5, age)).state is State.STALE
    # It was not lost: the next read has the same value, which is not published again.
    assert one.wake(1.0) <= 2.0
    assert one.next(good(5, 4.75), 2.0) == Carry(5, within=0.25)


def test_a_bad_value_is_not_carried() -> None:
    one = row()
    one.changed(5)
    assert one.next(BAD, 1.0) is None
    assert one.verdict(BAD)[:2] == (State.STALE, Code.NO_RESPONSE)


def test_a_write_that_was_not_done_is_tried_again_after_growing_pauses() -> None:
    one, now, tries = row(), 1.0, list[float]()
    one.changed(5)
    while len(tries) < 10:
        if one.next(good(5), now) is not None:
            tries.append(now)
            one.ended(NOT_DONE, now)
            assert one.verdict(good(5)).state is State.WAITING
        now = one.wake(now)
    pauses = [after - before for before, after in pairwise(tries)]
    assert pauses == [0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]


def test_a_write_is_not_tried_again_with_a_bad_or_old_value() -> None:
    one = row()
    assert carried(one, 5, 1.0) is not None
    one.ended(NOT_DONE, 1.0)
    assert one.next(BAD, 2.0) is None
    assert one.next(good(5, 6.0), 3.0) is None
    assert one.next(good(5), 4.0) is not None


def test_a_write_is_tried_again_at_once_when_the_target_replies() -> None:
    one = row()
    assert carried(one, 5, 1.0) is not None
    one.ended(NOT_DONE, 1.0)
    assert one.next(good(5), 1.1) is None
    one.target_online(1.2)
    assert one.next(good(5), 1.2) == Carry(5, within=5.0)


def test_the_newest_value_is_carried_after_a_write_that_was_not_done() -> None:
    one = row()
    assert carried(one, 5, 1.0) is not None
    one.ended(NOT_DONE, 1.0)
    assert carried(one, 7, 1.1) is None  # the pause is the target's
    assert one.next(good(7), 1.5) == Carry(7, within=5.0)


@pytest.mark.parametrize("error", [NoReply("silence"), Garbled("noise"), Unclear("lost")])
def test_an_unclear_write_is_not_repeated_until_the_next_change(error: GatewayError) -> None:
    one = row()
    assert carried(one, 5, 1.0) is not None
    one.ended(outcome_of(error), 2.0)
    assert one.verdict(good(5)).state is State.UNCLEAR
    assert [one.next(good(5), float(now)) for now in range(2, 60)] == [None] * 58
    assert carried(one, 5, 61.0) is None  # published again, as each ten minutes
    assert carried(one, 6, 62.0) is not None
    one.ended(DONE, 62.1)
    assert one.verdict(good(6)).state is State.CARRIED


def test_after_an_unclear_write_the_value_before_is_a_change() -> None:
    one = row()
    assert carried(one, 4, 0.0) is not None
    one.ended(DONE, 0.1)
    assert carried(one, 5, 1.0) is not None
    one.ended(UNCLEAR, 2.0)
    assert carried(one, 4, 3.0) is not None


def test_an_unclear_value_that_was_left_and_came_back_is_carried() -> None:
    one = row()
    assert carried(one, 5, 1.0) is not None
    assert [carried(one, value, 1.5) for value in (6, 5)] == [None, None]
    one.ended(UNCLEAR, 2.0)
    assert one.next(good(5), 2.0) == Carry(5, within=5.0)


def test_a_refused_write_is_not_repeated_until_the_next_change() -> None:
    one = row()
    assert carried(one, 500, 1.0) is not None
    one.ended(outcome_of(BadValue("above the greatest value 40")), 1.0)
    state, code, why = one.verdict(good(500))
    assert (state, code, why) == (State.REFUSED, None, "above the greatest value 40")
    assert one.next(good(500), 60.0) is None
    assert carried(one, 30, 61.0) is not None


def test_at_an_interval_the_present_value_is_carried_each_time() -> None:
    one, now, times = row(every=1.0), 0.25, list[float]()
    while now < 5:
        if one.next(good(5), now) is not None:
            times.append(now)
            one.ended(DONE, now + 0.03)
        now = one.wake(now)
    assert times == [0.25, 1.0, 2.0, 3.0, 4.0]


def test_at_an_interval_two_writes_are_never_under_way() -> None:
    one = row(every=1.0)
    assert one.next(good(1), 0.0) is not None
    assert [one.next(good(2), now / 10) for now in range(1, 80)] == [None] * 79
    one.ended(DONE, 7.9)
    assert one.next(good(3), 8.0) == Carry(3, within=5.0)
    one.ended(DONE, 8.1)
    assert one.next(good(3), 8.2) is None  # seven were left out


def test_at_an_interval_a_bad_source_is_left_out() -> None:
    one = row(every=1.0)
    assert one.next(BAD, 0.0) is None
    assert one.wake(0.0) == pytest.approx(0.625)
    assert one.next(good(5), 0.6) == Carry(5, within=5.0)


def test_the_substitute_is_written_once_for_each_time_that_the_source_is_too_old() -> None:
    one = row(substitute=0)
    assert carried(one, 5, 1.0) is not None
    one.ended(DONE, 1.1)
    assert one.next(BAD, 3.0) is None  # the last good read may be younger than 5 s
    assert one.wake(3.0) <= 4.0
    carry = one.next(BAD, 6.5)
    assert carry is not None
    assert (carry.value, carry.substitute) == (0, True)
    one.ended(DONE, 6.6)
    assert one.next(BAD, 600.0) is None
    # The target has the substitute, so the same value is carried again.
    assert one.next(good(5), 601.0) == Carry(5, within=5.0)
    one.ended(DONE, 601.1)
    assert one.next(good(5, 4.9), 602.0) is None
    assert one.next(good(5, 6.0), 607.0) is not None


def test_a_substitute_is_repeated_only_if_it_was_certainly_not_written() -> None:
    one = row(substitute=0)
    assert one.next(BAD, 6.0) is not None
    one.ended(NOT_DONE, 6.0)
    assert one.next(BAD, 6.1) is None
    assert one.next(BAD, 6.5) is not None
    one.ended(UNCLEAR, 7.0)
    assert one.next(BAD, 60.0) is None


def test_a_source_that_is_young_again_needs_no_substitute() -> None:
    one = row(substitute=0, every=10.0)
    for now in range(0, 100, 4):
        carry = one.next(good(5, 1.0), float(now))
        if carry is not None:
            assert not carry.substitute
            one.ended(DONE, float(now))


@pytest.mark.parametrize(
    ("error", "end", "code"),
    [
        (Busy("5 s"), End.NOT_DONE, Code.ABNORMAL),
        (Superseded("a newer value took its place"), End.REFUSED, None),
        (Offline("silent"), End.NOT_DONE, Code.NO_RESPONSE),
        (LineDown("unplugged"), End.NOT_DONE, Code.ABNORMAL),
        (Refused("busy", code="06", refusal=Refusal.BUSY), End.NOT_DONE, Code.ABNORMAL),
        (Refused("no", code="28", refusal=Refusal.ADDRESS), End.REFUSED, Code.DEVICE_NUMBER),
        (Refused("no", code="1"), End.REFUSED, Code.ABNORMAL),
        (BadValue("too large"), End.REFUSED, None),
        (NoReply("silence"), End.UNCLEAR, Code.NO_RESPONSE),
        (Garbled("noise"), End.UNCLEAR, Code.ABNORMAL),
        (Unclear("the port was lost"), End.UNCLEAR, Code.ABNORMAL),
    ],
)
def test_the_end_of_a_write_decides_if_it_may_be_repeated(
    error: GatewayError, end: End, code: Code | None
) -> None:
    assert outcome_of(error)[:2] == (end, code)


@pytest.mark.parametrize(
    ("known", "settings", "whole", "carried_value"),
    [
        (12.34, {}, False, 12.34),
        (12.5, {}, True, 12),
        (7, {"scale": 0.1}, False, 0.7),
        (0.1, {"scale": 3.0}, False, 0.3),
        (7, {"scale": 10.0, "offset": 1.0}, True, 71),
        (True, {}, False, True),
        ("AB", {}, False, "AB"),
        (1e308, {"scale": 1e10}, False, None),
    ],
)
def test_scale_and_offset_are_exact(
    known: Value, settings: dict[str, float], whole: bool, carried_value: Value | None
) -> None:
    found = rule(**settings).value(known, whole=whole)
    assert (found, type(found)) == (carried_value, type(carried_value))


def test_a_filled_value_lapses_once_with_its_source_and_is_carried_again() -> None:
    one = TransferRow(rule(), 0.0, fills=True)
    starting = SourceReading(None, float("inf"), Reason.STARTING)
    assert one.lapse(starting) is None
    assert carried(one, 5, 1.0) == Carry(5, within=5.0)
    assert one.lapse(BAD) is None  # the write is under way
    one.ended(DONE, 1.1)
    assert one.lapse(good(5, age=4.9)) is None
    assert one.wake(1.2) < 2.0  # the age is looked at, although nothing is to be carried
    found = one.lapse(good(5, age=5.0))
    assert found is not None
    assert found.why == "the last read of a/x is older than 5 s"
    assert one.lapse(BAD) is None
    assert one.next(good(5), 9.0) == Carry(5, within=5.0)
    one.ended(DONE, 9.1)
    assert one.lapse(BAD) is not None
    for other in (row(), TransferRow(rule(substitute=0), 0.0, fills=True)):
        assert carried(other, 5, 1.0) is not None
        other.ended(DONE, 1.1)
        assert other.lapse(BAD) is None


def test_the_age_of_the_source_is_looked_at_between_two_tries_of_a_write() -> None:
    """The substitute was written up to 30 s before its time: it was that of the last try."""
    one, now, stale = row(substitute=0, stale=20.0, every=1.0), 0.0, 20.0
    while now < 60.0:
        if one.next(good(5), now) is not None:
            one.ended(NOT_DONE, now)
        now = one.wake(now)
    last = now
    while (carry := one.next(BAD, now)) is None:
        now = one.wake(now)
    assert carry.substitute
    assert now >= last + stale - 1.0
