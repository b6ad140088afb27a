"""A short history of writes with faults, and the checker itself."""

from pathlib import Path

import pytest

from tests.faults.histories import Asked, Done, run, wrong


async def test_no_write_is_lost_done_twice_or_told_wrongly(tmp_path: Path) -> None:
    """`make histories` checks 100,000 writes."""
    made, found = await run(tmp_path, writes=800, tags=2, seed=11, every=0.5)
    assert found.wrong() == []
    assert made.faults
    assert found.outcomes()["written"] > 100


@pytest.mark.parametrize(
    ("answers", "executed", "said"),
    [
        (("written",), [5.5], []),
        (("busy",), [], []),
        ((), [5.5], []),
        (("unclear",), [7.0], []),
        (("timeout",), [], []),
        (("written",), [], ["1 was told as written, and was not"]),
        (("written",), [7.0], ["1 was told as written before it was"]),
        (("written", "written"), [5.5], ["1 has two acknowledgements"]),
        (("busy",), [7.0], ["1 was written, and told as ('busy',)"]),
        (("unclear",), [5.1, 5.5], ["1 was written 2 times: ('unclear',)"]),
    ],
)
def test_the_checker_finds_each_contradiction(
    answers: tuple[str, ...], executed: list[float], said: list[str]
) -> None:
    asked = [Asked(1, 5.0, 6.0, answers)]
    assert list(wrong(asked, [Done(1, at) for at in executed])) == said


def test_the_checker_finds_a_write_that_nobody_asked_for() -> None:
    assert list(wrong([], [Done(3, 1.0)])) == ["3 was written, and nobody asked for it"]
