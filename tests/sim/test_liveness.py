"""A slice of the pace `liveness`: one station is broken for ever, and the others live on."""

import pytest

from tests.sim.liveness import KINDS, Life, draw, run
from tests.sim.story import Story
from tests.sim.virtual import run_virtual

SEED, SLICE = 1_000_003, 0.02  # hours


# Flooding is not withstood at 9600 baud: docs/contributors/proof.md, "Not proven".
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "flooding"])
def test_beside_a_station_that_is_broken_for_ever_all_others_live_on(kind: str) -> None:
    story = run(SEED, SLICE, only=[kind])
    assert story.broken == []
    assert story.counts["sweeps"] > 50
    assert story.counts["writes"] > 5


def test_the_judge_sees_that_others_lose_their_sweeps() -> None:
    """Here all stations are too slow."""
    drawn, story = draw(SEED, ["mute"]), Story(SEED, SLICE, "liveness")
    for part in drawn.parts:
        part.delay = 0.45
    run_virtual(Life(drawn, story, SLICE * 3600).run())
    assert set(story.rules()) == {"not polled"}
