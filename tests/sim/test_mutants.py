"""The mutants of `make mutants` are programs, and the tests notice them."""

import ast
from pathlib import Path

import pytest

from tests.sim.mutants import PYTEST, REST, ROOMS, ROOT, all_mutants, checks_near, verdicts
from tests.sim.mutate import GATEWAY, Mutant, modules_in, mutants_of, sample


@pytest.fixture(scope="module")
def made() -> list[Mutant]:
    return all_mutants()


def test_every_room_has_modules_and_tests(made: list[Mutant]) -> None:
    modules = {mutant.module for mutant in made}
    assert [room for room in ROOMS if not modules & set(modules_in(room))] == []
    named = {*REST, *(path for module in modules for path in checks_near(module))}
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_a_name_means_one_mutant(made: list[Mutant]) -> None:
    assert len({mutant.name for mutant in made}) == len(made) > 20_000


def test_a_mutant_is_another_program(made: list[Mutant]) -> None:
    for mutant in sample(made, 100, seed=7):
        right = (GATEWAY / mutant.module).read_text()
        compile(mutant.text(), mutant.name, "exec")
        assert ast.dump(ast.parse(mutant.text())) != ast.dump(ast.parse(right)), mutant


def test_a_seed_draws_the_same_mutants_again(made: list[Mutant]) -> None:
    assert sample(made, 20, seed=3) == sample(made, 20, seed=3) != sample(made, 20, seed=4)


def test_each_operator_makes_its_mutants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rule.py").write_text(
        '"""A rule."""\n'
        "LIMIT: int = 3\n"
        "class Rule:\n"
        "    def due(self, now: float = 0.0) -> bool:\n"
        "        if self.ready and now > LIMIT:\n"
        "            self.last = now\n"
        "        log.info('so %d', 1)\n"
        "        return min(now, 2) + self.last in self.times\n"
    )
    monkeypatch.setattr("tests.sim.mutate.GATEWAY", tmp_path)
    lines = (tmp_path / "rule.py").read_text().splitlines()
    told = {
        mutant.name.removeprefix("rule.py:"): new.strip()
        for mutant in mutants_of("rule.py")
        for old, new in zip(lines, mutant.text().splitlines(), strict=True)
        if new != old
    }
    sum_of = "min(now, 2) + self.last"
    assert told == {
        ":constant:0": "LIMIT: int = 4",
        "Rule.due:negate:0": "if (not (self.ready and now > LIMIT)):",
        "Rule.due:skip:0": "if False:",
        "Rule.due:either:0": "if ((self.ready) or (now > LIMIT)):",
        "Rule.due:part:0": "if True and now > LIMIT:",
        "Rule.due:part:1": "if self.ready and True:",
        "Rule.due:swap:0": "if self.ready and ((now) < (LIMIT)):",
        "Rule.due:bound:0": "if self.ready and ((now) >= (LIMIT)):",
        "Rule.due:drop:0": "pass",
        "Rule.due:drop:1": "pass",
        "Rule.due:swap:1": f"return (({sum_of}) not in (self.times))",
        "Rule.due:sum:0": "return ((min(now, 2)) - (self.last)) in self.times",
        "Rule.due:choice:0": "return max(now, 2) + self.last in self.times",
        "Rule.due:constant:0": "return min(now, 3) + self.last in self.times",
    }


def test_tests_notice_a_broken_rule_and_pass_without_one() -> None:
    command = (*PYTEST, "tests/engine/test_health.py")
    [health] = [module for module in modules_in("engine") if module.endswith("/health.py")]
    moves = [m for m in mutants_of(health) if ":drop:" in m.name and "_move" in str(m)]
    none = Mutant("none", health, 0, 0, "")
    judged = verdicts([*moves[:2], none], 1, lambda module: {"tests": command})
    assert [verdict.by for verdict in judged] == ["tests", "tests", ""]
