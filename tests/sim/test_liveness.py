"""A slice of the pace `liveness`: one station is broken for ever, and the others live on."""

import pytest

from tests.sim.liveness import KINDS, NOT_ON_NETWORKS, Life, draw, run
from tests.sim.story import Story
from tests.sim.virtual import run_virtual

SERIAL, NETWORK, SLICE = 1_500_207, 1_500_211, 0.02  # hours
CASES = [(kind, SERIAL) for kind in KINDS] + [
    (kind, NETWORK) for kind in KINDS if kind not in NOT_ON_NETWORKS
]


@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_beside_a_station_that_is_broken_for_ever_all_others_live_on(kind: str, seed: int) -> None:
    story = run(seed, SLICE, only=[kind])
    assert story.broken == []
    assert story.counts["sweeps"] > 40
    assert story.counts["writes"] > 5


def test_a_flood_behind_sound_replies_destroys_no_request_to_another_station() -> None:
    """One write was not sent: all requests behind those to the flooding station were destroyed."""
    assert run(1_500_201, 6 * SLICE).broken == []


def test_the_cases_are_a_serial_line_and_a_network() -> None:
    found = [draw(seed, ["mute"]).plant.devices[0].driver.protocol for seed in (SERIAL, NETWORK)]
    assert found == ["modbus-ascii", "modbus-tcp"]


def test_the_judge_sees_that_others_lose_their_sweeps() -> None:
    """Here all stations are too slow."""
    drawn, story = draw(SERIAL, ["mute"]), Story(SERIAL, SLICE, "liveness")
    for part in drawn.parts:
        part.delay = 0.45
    run_virtual(Life(drawn, story, SLICE * 3600).run())
    assert set(story.rules()) == {"not polled"}
