"""Every mutant of `make mutants` still changes the gateway."""

from tests.sim.mutants import stale


def test_every_mutant_finds_its_text_once() -> None:
    assert stale() == []
