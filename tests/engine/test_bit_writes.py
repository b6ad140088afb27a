"""A device that has function 22 changes a bit by itself; otherwise the outcome tells the race."""

import pytest

from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Poll, Sent
from gateway.engine.jobs.requests import RACE, Write
from gateway.engine.results.bit_writes import LACKED_FOR
from gateway.errors import DeviceError, Refusal, Refused
from gateway.tags import WriteResult
from gateway.values import Value
from tests.engine.rig import SILENCE, Rig, bit_device, link_device
from tests.engine.test_change import change

LACKS = Refused("no such function", code="01", unexecuted=True)
BUSY = Refused("busy", code="06", refusal=Refusal.BUSY, unexecuted=True)
ADDRESS = Refused("no such address", code="02", refusal=Refusal.ADDRESS)
FAULT = Refused("it failed in the middle", code="04")


def sent(rig: Rig, text: str = "holding:7.3", value: Value = True) -> Write:
    """The write, on its way."""
    rig.write(text, value)
    return following(rig)


def following(rig: Rig) -> Write:
    """The next write; polls before it are good."""
    while not isinstance(job := rig.transacted(), Write):
        assert isinstance(job, Poll)
        rig.conclude(job, [0] * job.span.size)
    return job


@pytest.fixture
def rig() -> Rig:
    rig = Rig(bit_device())
    rig.bring(State.ONLINE)
    return rig


def test_the_device_changes_the_bit_and_there_is_no_race(rig: Rig) -> None:
    for _ in range(2):
        write = sent(rig)
        assert write.masked
        rig.conclude(write, Sent())
        outcome = rig.outcomes[write]
        assert isinstance(outcome, WriteResult)
        assert outcome.note == ""


@pytest.mark.parametrize("refusal", [LACKS, ADDRESS])
def test_a_refused_one_is_sent_again_as_a_word(rig: Rig, refusal: Refused) -> None:
    write = sent(rig)
    rig.conclude(write, refusal)
    assert rig.outcomes == {}
    again = following(rig)
    assert again is write
    assert not write.masked
    rig.conclude(again, Sent())
    outcome = rig.outcomes[write]
    assert isinstance(outcome, WriteResult)
    assert outcome.note == RACE
    # A refused address says nothing of the function.
    assert sent(rig, "holding:7.4").masked is (refusal is ADDRESS)


def test_a_device_that_lacks_it_is_tried_again_after_an_hour(rig: Rig) -> None:
    write = sent(rig)
    rig.conclude(write, LACKS)
    rig.conclude(following(rig), Sent())
    rig.now += LACKED_FOR
    rig.engine.expire(rig.now, rig.time)
    assert sent(rig).masked


def test_a_device_that_lacks_it_lacks_it_after_a_reload_too(rig: Rig) -> None:
    rig.conclude(sent(rig), LACKS)
    rig.conclude(following(rig), Sent())
    change(rig, rig.device, late_guard=0.7)
    assert not sent(rig).masked


@pytest.mark.parametrize(("error", "next_one"), [(SILENCE, False), (BUSY, True), (FAULT, True)])
def test_one_that_did_not_end_well_is_not_sent_again(
    rig: Rig, error: DeviceError, next_one: bool
) -> None:
    write = sent(rig)
    if error is SILENCE:
        rig.fail(write)
    else:
        rig.conclude(write, error)
    assert rig.outcomes[write] is error
    after = Write(rig.device, rig.device.tags[1], [1], rig.now)
    for rule in rig.engine.rules.preparing:
        rule.before(after, rig.now)
    assert after.masked is next_one


def test_a_word_and_a_device_without_the_function_have_no_mask(rig: Rig) -> None:
    assert not sent(rig, "holding:8", 7).masked
    plc = Rig(link_device())
    plc.bring(State.ONLINE)
    assert not sent(plc, "D0", 7).masked
