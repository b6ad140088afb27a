"""A second station with the number of a device."""

from typing import Any

from gateway.engine.device.twins import FOR, KEPT, LAST, Twins
from gateway.errors import Refusal, Refused
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
