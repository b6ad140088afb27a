"""Tables of values."""

from pathlib import Path
from typing import Any

from rich.console import Console

from gateway.cli.client import Row
from gateway.cli.tables import row_of, table_of
from gateway.tags import Reason, bad, good
from tests.cli.conftest import tags_of

NOW = 1_795_235_763_007_430_146


def printed(table: Any) -> list[str]:
    console = Console(width=200, markup=False, emoji=False, highlight=False)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


def test_a_table_of_good_and_bad_samples(tmp_path: Path) -> None:
    tags = tags_of(tmp_path, {"speed": {"address": "D1", "unit": "rpm"}, "run": {"address": "M1"}})
    speed, run = tags["mixer/speed"], tags["mixer/run"]
    rows = [
        row_of(good(speed, -7, NOW)),
        row_of(bad(speed, Reason.NO_REPLY, NOW)),
        row_of(good(run, False, NOW)),
        Row("other/tag", {"value": "[red]:boom:", "quality": "good", "time": "now"}),
    ]
    header, *lines = [line.split() for line in printed(table_of(rows, tags))]
    time = "2026-11-21T04:36:03.007430Z"
    assert header == ["tag", "value", "unit", "quality", "time"]
    assert lines == [
        ["mixer/speed", "-7", "rpm", "good", time],
        ["mixer/speed", "-", "rpm", "bad:", "no-reply", time],
        ["mixer/run", "false", "good", time],
        ["other/tag", "[red]:boom:", "good", "now"],
    ]
