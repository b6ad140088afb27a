"""A device that replies twice in a row that it is busy is left alone, longer each time."""

import pytest

from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Poll
from gateway.engine.jobs.requests import Write
from gateway.errors import Refusal, Refused
from tests.engine.rig import Rig, link_device
from tests.engine.test_change import change

USUAL = 1.0  # second: the interval of the tags
BUSY = Refused("busy", code="06", refusal=Refusal.BUSY)
DAMAGED = Refused("damaged", code="11", refusal=Refusal.DAMAGED)


def polled(rig: Rig) -> Poll:
    poll = rig.transacted()
    assert isinstance(poll, Poll)
    return poll


def pauses(text: str) -> list[float]:
    """Seconds from each end of a poll to the next poll: `b` is busy, `g` good, `r` another
    refusal."""
    rig = Rig(link_device(retries=0))
    rig.bring(State.ONLINE)
    found, ended = [], rig.now
    for letter in text:
        poll = polled(rig)
        found.append(rig.now - ended)
        match letter:
            case "b":
                rig.conclude(poll, BUSY)
            case "r":
                rig.conclude(poll, DAMAGED)
            case "g":
                rig.conclude(poll, [0] * poll.span.size)
        ended = rig.now
    return found[1:]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bg", [USUAL]),  # once may be chance
        ("bbg", [USUAL, 2.0]),
        ("bbbbbbbbg", [USUAL, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]),
        ("bbgbg", [USUAL, 2.0, USUAL, USUAL]),  # as usual at once
        ("bbrbg", [USUAL, 2.0, USUAL, USUAL]),  # another refusal is an answer, too
    ],
)
def test_a_busy_device_is_left_alone(text: str, expected: list[float]) -> None:
    assert pauses(text) == pytest.approx(expected, abs=0.15)


def test_a_write_to_a_busy_device_is_sent_at_once() -> None:
    rig = Rig(link_device(retries=0))
    rig.bring(State.ONLINE)
    for _ in range(3):
        rig.conclude(polled(rig), BUSY)
    rig.write("D0")
    assert isinstance(rig.next(), Write)


def test_a_busy_device_is_left_alone_after_a_reload_too() -> None:
    rig = Rig(link_device(retries=0))
    rig.bring(State.ONLINE)
    for _ in range(5):
        rig.conclude(polled(rig), BUSY)
    since = rig.now
    change(rig, rig.device, late_guard=0.7)
    polled(rig)
    assert rig.now - since > 10.0
