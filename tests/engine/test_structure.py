"""The shape of the code: no worse than its limits, and as architecture.md says."""

import re
from pathlib import Path

import pytest

from benchmarks import moves, structure

PAGE = (Path(__file__).parents[2] / "docs" / "contributors" / "architecture.md").read_text("utf-8")


def now(row: str) -> list[int]:
    """The figures of a row of the page, in its last column."""
    [line] = [line for line in PAGE.splitlines() if line.startswith(f"| {row}")]
    return [int(number) for number in re.findall(r"\d+", line.split("|")[-2])]


def test_a_poll_and_a_write_enter_as_few_files_as_the_page_says() -> None:
    said = [now("files entered, moves between files, for one"), now("the same for one")]
    for _ in range(5):  # a slow machine makes most of them longer: they wait for silence
        found = [
            [len({call.file for call in calls}), moves.moves(calls)]
            for calls in moves.usual().values()
        ]
        if found == said:
            break
    assert found == said


@pytest.mark.parametrize("row", structure.FIGURES)
def test_the_page_has_the_figures_that_are_printed(row: str) -> None:
    assert structure.FIGURES[row]() == now(row)


def test_the_figures_are_within_their_limits() -> None:
    assert 0 < structure.foreign_assignments("engine") <= 15
    arrows = structure.arrows()
    assert 10 < len(arrows) <= 20
    assert 50 < sum(map(len, arrows.values())) <= 125
    assert structure.circle(arrows) == structure.circle(structure.engine_imports()) == []
    assert structure.fullest()[0] <= 20


def test_each_long_and_each_short_module_has_its_reason() -> None:
    page = (Path(structure.__file__).parents[1] / "docs/contributors/modules.md").read_text("utf-8")
    explained = re.findall(r"^\| `(\S+\.py)` \| \w", page, re.MULTILINE)
    assert explained == [f"gateway/{name.split()[0]}" for name in structure.crowded()]


def test_a_circle_is_found() -> None:
    assert set(structure.circle({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == {"b", "c"}
