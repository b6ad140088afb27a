"""Tables of values."""

import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gateway.cli.client import TagRow
from gateway.cli.tables import row_of, table_of, time_text
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
        TagRow("other/tag", {"value": "[red]:boom:", "quality": "good", "time": "now"}),
    ]
    header, *lines = [line.split() for line in printed(table_of(rows, tags, utc=True))]
    at = "2026-11-21T04:36:03.007430Z"
    assert header == ["tag", "value", "unit", "quality", "time"]
    assert lines == [
        ["mixer/speed", "-7", "rpm", "good,", "simulated", at],
        ["mixer/speed", "-", "rpm", "bad:", "no-reply", at],
        ["mixer/run", "false", "good,", "simulated", at],
        ["other/tag", "[red]:boom:", "good", "now"],
    ]


def test_times_are_shown_in_the_zone_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        assert time_text("2026-11-21T04:36:03.007430Z") == "2026-11-21T05:36:03.007+01:00"
        assert time_text("2026-07-21T04:36:03.007430Z") == "2026-07-21T06:36:03.007+02:00"
        assert time_text("2026-11-21T04:36:03Z", utc=True) == "2026-11-21T04:36:03Z"
    finally:
        monkeypatch.undo()
        time.tzset()


@pytest.mark.parametrize("text", ["", "now", "0001-01-01T00:00:00Z\x1b[2J"])
def test_a_time_that_is_none_is_shown_without_control_characters(text: str) -> None:
    assert time_text(text) == text.replace("\x1b", "\\x1b")
