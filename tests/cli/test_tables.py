"""Tables and sentences for people."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gateway.cli import tables as show
from gateway.cli.client import Shown
from gateway.config import load
from gateway.tags import Reason, bad, good
from tests.e2e.processes import vigor_line, write_config

NOW = 1_795_235_763_007_430_146


def printed(table: Any) -> list[str]:
    console = Console(width=200, markup=False, emoji=False, highlight=False)
    with console.capture() as capture:
        console.print(table)
    return [line.rstrip() for line in capture.get().splitlines()]


def tags_of(folder: Path, tags: dict[str, Any]) -> dict[str, Any]:
    path = write_config(
        folder / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", tags)}
    )
    return {tag.key: tag for device in load(path).devices for tag in device.tags}


def test_good_and_bad_samples_side_by_side(tmp_path: Path) -> None:
    tags = tags_of(tmp_path, {"speed": {"address": "D1", "unit": "rpm"}, "run": {"address": "M1"}})
    speed, run = tags["mixer/speed"], tags["mixer/run"]
    rows = [
        show.shown(good(speed, -7, NOW)),
        show.shown(bad(speed, Reason.NO_REPLY, NOW)),
        show.shown(good(run, False, NOW)),
        Shown("other/tag", {"value": "[red]:boom:", "quality": "good", "time": "now"}),
    ]
    header, *lines = [line.split() for line in printed(show.samples(rows, tags))]
    time = "2026-11-21T04:36:03.007430Z"
    assert header == ["tag", "value", "unit", "quality", "time"]
    assert lines == [
        ["mixer/speed", "-7", "rpm", "good", time],
        ["mixer/speed", "-", "rpm", "bad:", "no-reply", time],
        ["mixer/run", "false", "good", time],
        ["other/tag", "[red]:boom:", "good", "now"],
    ]


@pytest.mark.parametrize(
    ("count", "height", "shown"),
    [(3, 4, 3), (3, 3, 1), (22, 12, 10), (22, 23, 22), (22, 22, 20), (2, 1, 0), (0, 5, 0)],
)
def test_a_table_higher_than_the_screen_says_how_many_rows_are_hidden(
    tmp_path: Path, count: int, height: int, shown: int
) -> None:
    lines = on_a_screen(tmp_path, 200, height, ["7"] * count)
    table = lines[: 1 + shown]
    assert [line.split()[0] for line in table] == ["tag", *(f"mixer/t{n}" for n in range(shown))]
    more = f"{count - shown} more: name the tags you want to see, or enlarge the window"
    assert lines[1 + shown :] == ([more] if count > shown else [])


def test_a_text_of_several_lines_takes_the_room_of_others(tmp_path: Path) -> None:
    lines = on_a_screen(tmp_path, 80, 10, ["some words " * 6] * 6)
    assert len(lines) <= 10
    shown = sum(line.startswith("mixer/t") for line in lines)
    assert 1 <= shown < 6
    assert lines[-1].startswith(f"{6 - shown} more: ")


def on_a_screen(folder: Path, width: int, height: int, values: list[str]) -> list[str]:
    tags = tags_of(folder, {})
    document = {"quality": "good", "time": "2026-11-20T12:00:00.123456Z"}
    rows = [Shown(f"mixer/t{n}", {"value": value, **document}) for n, value in enumerate(values)]
    screen = Console(width=width, height=height, markup=False, emoji=False, highlight=False)
    with screen.capture() as capture:
        screen.print(show.fitting(screen, rows, tags))
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0123, "12.3 ms"), (0.9994, "999.4 ms"), (1.434, "1.43 s"), (float("inf"), "inf s")],
)
def test_times(seconds: float, text: str) -> None:
    assert show.seconds(seconds) == text


@pytest.mark.parametrize(
    ("answer", "line"),
    [
        (
            {"value": 12, "took": 0.0311, "verified": True},
            "t = 12: acknowledged and read back, 31 ms",
        ),
        (
            {"value": True, "took": 0.031, "verified": False},
            "t = true: acknowledged by the PLC, 31 ms",
        ),
        (
            {"value": 1, "took": 0.1, "verified": False, "acknowledged": False},
            "t = 1: broadcast, nobody acknowledges it, 100 ms",
        ),
        (
            {"error": "refused", "code": "28", "reason": "data address out of range"},
            "t: refused 28: data address out of range",
        ),
        ({"error": "busy", "code": None, "reason": "later"}, "t: busy: later"),
    ],
)
def test_how_a_write_ended(answer: dict[str, object], line: str) -> None:
    assert show.outcome("t", answer) == line


@pytest.mark.parametrize(
    ("tag", "typed"),
    [
        ({"address": "D1", "write": {"min": -5, "max": 40}}, "-4"),
        ({"address": "D1", "write": {"min": 7, "max": 7}}, "7"),
        ({"address": "D1", "write": {"max": -10}}, "-10"),
        ({"address": "D1", "scale": 0.1, "write": {"min": 0.5, "max": 1}}, "1"),
        ({"address": "D1", "write": True}, "1"),
        ({"address": "D1", "type": "float32", "write": {"min": 0.25, "max": 0.5}}, "0.5"),
        ({"address": "Y20", "write": True}, "true"),
        ({"address": "D1", "type": "string[2]", "write": True}, "AB"),
        ({"address": "D1", "type": "string[1]", "write": True}, "A"),
    ],
)
def test_the_write_that_is_proposed_is_one_that_is_taken(
    tmp_path: Path, tag: dict[str, Any], typed: str
) -> None:
    path = write_config(
        tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", {"t": tag})}
    )
    config = load(path)
    steps = show.next_steps(config, path, "plc-gateway").splitlines()
    [line] = [line for line in steps if line.startswith("  plc-gateway write")]
    assert line == f"  plc-gateway write {path} mixer/t {typed}"
    [made] = config.devices[0].tags
    try:
        value = json.loads(typed)
    except ValueError:
        value = typed
    made.encode(value)


def test_a_path_with_a_blank_can_be_typed(tmp_path: Path) -> None:
    tags = {"t": {"address": "D1"}}
    path = write_config(
        tmp_path / "my plant.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", tags)}
    )
    assert f"plc-gateway watch '{path}'" in show.next_steps(load(path), path, "plc-gateway")


@pytest.mark.parametrize(
    ("started", "found", "typed"),
    [
        (".venv/bin/plc-gateway", None, ".venv/bin/plc-gateway"),
        ("/usr/bin/plc-gateway", "/usr/bin/plc-gateway", "plc-gateway"),
        ("/x/gateway/__main__.py", None, f"{sys.executable} -m gateway"),
    ],
)
def test_what_is_to_be_typed_works_where_it_is_read(
    monkeypatch: pytest.MonkeyPatch, started: str, found: str | None, typed: str
) -> None:
    monkeypatch.setattr(sys, "argv", [started])
    monkeypatch.setattr(shutil, "which", lambda name: found)
    assert show.typed() == typed
