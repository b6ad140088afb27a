"""A second station with the number of a device."""

from typing import Any

import pytest

from gateway.engine.device.twins import FOR, KEPT, LAST, Twins
from gateway.engine.jobs.jobs import Result, Sent
from gateway.engine.jobs.requests import Command
from gateway.errors import Busy, Refusal, Refused, Unclear
from gateway.protocols.driver import Span
from gateway.tags import WriteResult
from tests.engine.rig import Rig
from tests.engine.test_proofs import doubtful, good, prove, read


def answered(twins: Twins, requests: int, *replies: Any) -> None:
    """Each request has the first of the replies; the others arrive after it."""
    for _ in range(requests):
        twins.asked()
        twins.replied((replies[0], lambda frame: frame if frame > 0 else None))
        for frame in replies[1:]:
            twins.arrived(frame, 1.0)


def test_two_stations_answer_most_requests_twice_and_say_different_things() -> None:
    twins = Twins()
    answered(twins, KEPT, 7, 8)
    answered(twins, KEPT // 2, 7)
    assert twins.exist(2.0)
    answered(twins, 1, 7)
    assert not twins.exist(2.0)


def test_half_of_the_last_few_requests_are_enough() -> None:
    twins = Twins()
    answered(twins, KEPT, 7)
    answered(twins, LAST // 2, 7, 8)
    answered(twins, LAST - LAST // 2, 8)  # alone
    assert twins.exist(2.0)
    answered(twins, 1, 8)
    assert not twins.exist(2.0)


def test_repeated_replies_are_equal() -> None:
    twins = Twins()
    answered(twins, KEPT, 7, 7)
    assert not twins.exist(2.0)


def test_replies_to_another_master_answer_no_request_of_ours() -> None:
    twins = Twins()
    answered(twins, KEPT, 7, -8)
    assert not twins.exist(2.0)


def test_ten_minutes_without_a_difference_end_it() -> None:
    twins = Twins()
    answered(twins, KEPT, 7, 8)
    assert twins.exist(1.0 + FOR - 0.1)
    assert not twins.exist(1.0 + FOR + 0.1)


def test_a_refusal_by_the_other_station_is_another_reply() -> None:
    def answers(frame: Any) -> Any:
        raise Refused("it lacks the address", code="06", refusal=Refusal.ADDRESS)

    twins = Twins()
    for _ in range(KEPT):
        twins.asked()
        twins.replied((7, answers))
        twins.arrived(8, 1.0)
    assert twins.exist(2.0)


def test_a_reply_that_came_alone_is_no_value_while_two_stations_answer() -> None:
    rig = doubtful()
    assert rig.device.shapes is not None
    answered(rig.device.shapes.proofs.twins, KEPT, 7, 8)
    read(rig)
    prove(rig)
    assert not good(rig)
    for _ in range(KEPT):
        read(rig)
        prove(rig)
    assert good(rig)


REFUSED = Refused("not in RUN", code="18")


def two_stations() -> tuple[Rig, Twins]:
    """A device of which it is known."""
    rig = doubtful()
    read(rig)
    prove(rig)
    assert rig.device.shapes is not None
    answered(twins := rig.device.shapes.proofs.twins, KEPT, 7, 8)
    return rig, twins


@pytest.mark.parametrize(
    ("tag", "result", "outcome"),
    [
        ("D0", Sent(), Unclear),
        ("D2", Sent(held=[7]), Unclear),  # the other one may hold it
        ("D0", REFUSED, Unclear),  # the right one may have done it
        ("D0", Busy("nothing was sent"), Busy),
        ("D0", Sent(acknowledged=False), WriteResult),
    ],
)
def test_while_two_stations_answer_a_reply_to_a_write_tells_nothing(
    tag: str, result: Result, outcome: type
) -> None:
    rig, _ = two_stations()
    write = rig.write(tag, 7)
    rig.conclude(rig.transacted(), result)
    assert type(rig.outcomes[write]) is outcome


def test_ten_minutes_after_two_stations_replied_a_write_is_done_again() -> None:
    rig, twins = two_stations()
    answered(twins, KEPT, 7)  # one of them alone: it may be the wrong one
    write = rig.write("D0")
    rig.conclude(rig.transacted(), Sent())
    assert isinstance(rig.outcomes[write], Unclear)
    assert not twins.may_reply(1.0 + FOR)


@pytest.mark.parametrize(
    ("span", "result", "outcome"),
    [(None, "done", Unclear), (None, REFUSED, Unclear), (Span("D", 0, 1), "7", Busy)],
)
def test_nor_does_a_reply_to_a_command_or_a_peek(
    span: Span | None, result: Result, outcome: type
) -> None:
    rig, _ = two_stations()
    command = Command(rig.device, "run", "", rig.now, span=span)
    rig.engine.submit(command, rig.now)
    rig.conclude(rig.transacted(), result)
    assert type(rig.outcomes[command]) is outcome
