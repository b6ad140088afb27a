"""The tables of IEC 62443-4-2 and of the threat model name tests that exist, and are counted."""

import re
from collections import Counter
from pathlib import Path

import pytest

from tests.e2e.processes import ROOT

IEC, THREATS = ROOT / "docs/iec62443.md", ROOT / "docs/threat-model.md"
TEST = re.compile(r"`(test_\w+)`")
KNOWN = Counter(
    name
    for file in (ROOT / "tests").rglob("test_*.py")
    for name in re.findall(r"^(?:async )?def (test_\w+)", file.read_text("utf-8"), re.MULTILINE)
)


def rows(page: Path, columns: int) -> list[list[str]]:
    cells = [
        [cell.strip() for cell in line[1:-1].split("|")]
        for line in page.read_text("utf-8").splitlines()
        if line.startswith("| ")
    ]
    return [row for row in cells if len(row) == columns and row[-1] not in {"test", "what is left"}]


@pytest.mark.parametrize("page", [IEC, THREATS], ids=lambda page: page.name)
def test_every_test_of_the_page_exists_once(page: Path) -> None:
    named = set(TEST.findall(page.read_text("utf-8")))
    assert len(named) > 10
    assert {name: KNOWN[name] for name in named if KNOWN[name] != 1} == {}


def test_a_requirement_is_met_by_a_test_and_the_page_counts_them() -> None:
    requirements = rows(IEC, 5)
    for requirement, level, state, how, tests in requirements:
        assert re.match(r"(CR|SAR) \d\.\d", requirement), requirement
        assert level in {"1", "2"}, requirement
        assert how, requirement
        assert (state == "not met") <= (tests == ""), requirement
        assert (state in {"met", "part"}) <= bool(TEST.search(tests)), requirement
    counted = Counter((row[1], row[2]) for row in requirements)
    states = ("met", "part", "not met", "host")
    assert set(counted) <= {(level, state) for level in "12" for state in states}
    table = {row[0]: row[1:] for row in rows(IEC, 3) if row[0] in states}
    assert table == {
        state: [str(counted["1", state]), str(counted["2", state])] for state in states
    }


def test_a_threat_has_a_measure_with_a_test_or_says_what_is_left() -> None:
    threats = rows(THREATS, 5)
    assert len(threats) > 15
    for _place, threat, measure, tests, left in threats:
        assert measure, threat
        assert TEST.search(tests) or (measure.startswith("none") and left), threat
