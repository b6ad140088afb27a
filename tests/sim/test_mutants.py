"""Every mutant of `make mutants` still changes the gateway."""

from tests.sim.broken import MUTANTS
from tests.sim.mutants import ROOT, stale


def test_every_mutant_finds_its_text_once() -> None:
    assert stale() == []


def test_every_mutant_names_tests_that_exist() -> None:
    named = {path for mutant in MUTANTS for path in mutant.tests.split()}
    assert {path for path in named if not (ROOT / path).exists()} == set()


def test_every_mutant_is_a_program() -> None:
    """A syntax error would fail every check without testing a rule."""
    for mutant in MUTANTS:
        text = (ROOT / "gateway" / mutant.file).read_text()
        compile(text.replace(mutant.old, mutant.new), mutant.name, "exec")
