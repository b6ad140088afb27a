"""The mutants of `make mutants` are mutants yet."""

from tests.sim.mutants import stale


def test_every_mutant_finds_its_text_once() -> None:
    """Where the gateway is written anew, its mutants are too."""
    assert stale() == []
