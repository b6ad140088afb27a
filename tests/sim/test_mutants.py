"""Every mutant of `make mutants` still changes the gateway."""

from tests.sim.broken import MUTANTS
from tests.sim.mutants import ROOT, stale


def test_every_mutant_finds_its_text_once() -> None:
    assert stale() == []


def test_every_mutant_names_tests_that_exist() -> None:
    named = {path for mutant in MUTANTS for path in mutant.tests.split()}
    assert {path for path in named if not (ROOT / path).exists()} == set()
