"""Doors of a line with faults: a short slice of `make sim PACE=doors`."""

from collections import Counter

from tests.sim.doors import run


def test_no_program_and_no_tag_gets_what_belongs_to_another() -> None:
    found = Counter[str]()
    for seed in range(3):
        world = run(seed, 300.0)
        assert world.wrong == []
        found += world.found
    assert found["read"] > 100
    assert found["written"] > 40
    assert found["value"] > 200
    faults = ("wire lent", "reload", "stall", "held", "doubts", "standby", "vanish")
    assert [one for one in faults if not found[one]] == []
