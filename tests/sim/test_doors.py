"""Doors of a line with faults: a short slice of `python -m tests.sim.doors`."""

import pytest

from tests.sim.doors import run


@pytest.mark.parametrize("seed", range(2))
def test_no_program_and_no_tag_gets_what_belongs_to_another(seed: int) -> None:
    world = run(seed, 300.0)
    assert world.wrong == []
    assert world.found["read"] > 50
    assert world.found["written"] > 20
    assert world.found["value"] > 100
    assert world.found["wire lent"] > 0
    assert world.found["reload"] > 0
