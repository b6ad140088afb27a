"""The `watch` command, and its table on a screen."""

import json
import os
import re
import signal
import subprocess
import sys
import termios
from contextlib import suppress
from pathlib import Path

import pytest
from rich.console import Console

from gateway.cli.client import TagRow
from gateway.cli.watch import fitted
from tests.cli.conftest import documents, tags_of
from tests.e2e.processes import PATIENCE, Program, gateway, started, vigor_line, write_config
from tests.zenoh_peer import free_endpoint


def test_watch_prints_changes_until_ctrl_c(running: Path) -> None:
    with gateway("watch", running, "mixer/speed", "--json") as watch:
        first = json.loads(watch.says("mixer/speed"))["value"]
        wait_for_another_value(watch, first)
        assert watch.end(signal.SIGINT) == 0
        assert not watch.has_said("Traceback")


def test_watch_on_a_terminal_is_a_live_table(running: Path) -> None:
    master, slave = os.openpty()
    termios.tcsetwinsize(slave, (40, 120))
    watch = subprocess.Popen(
        [sys.executable, "-m", "gateway", "watch", running, "mixer/speed", "mixer/run"],
        stdin=slave,
        stdout=slave,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(slave)
    try:
        text = ""
        while len(set(re.findall(r"mixer/speed +(\d+) +rpm +good", text))) < 3:
            text += os.read(master, 4096).decode()  # ends when the program does
        watch.send_signal(signal.SIGINT)
        with suppress(OSError):  # EIO: the other side is closed
            while os.read(master, 4096):
                pass
        assert watch.wait(PATIENCE) == 0
        assert re.search(r"mixer/run +(true|false) +good", text)
    finally:
        watch.kill()
        watch.wait()
        os.close(master)


def test_watch_ends_with_its_reader(running: Path) -> None:
    """As in `plc-gateway watch … | head -1`."""
    watch = f"{sys.executable} -m gateway watch {running} mixer/speed --json | head -n 1"
    done = subprocess.run(
        ["sh", "-c", watch], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert [row["tag"] for row in documents(done.stdout)] == ["mixer/speed"]
    assert done.stderr == ""


def test_watch_waits_for_a_gateway_that_starts_later(tmp_path: Path) -> None:
    """As in two terminals: `make run`, and at the same moment the command that it names."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with gateway("watch", path, "--json") as watch:
        watch.says("waiting for it")
        with started(path):
            watch.says('"quality": "good"')


def test_watch_shows_bad_values_while_the_gateway_is_down(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as first:
        first.says("device online")
        with gateway("watch", path, "--json") as watch:
            watch.says('"quality": "good"')
            first.end(signal.SIGKILL)
            bad = json.loads(watch.says('"reason": "no-gateway"'))
            assert (bad["tag"], bad["value"], bad["quality"]) == ("mixer/speed", None, "bad")
            seen = len(watch.lines)
            with started(path):
                watch.says('"quality": "good"', after=seen)


def test_watch_shows_changes_of_a_device_that_publishes_only_blocks(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}}, blocks="only")}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device online")
        with gateway("watch", path, "--json") as watch:
            wait_for_another_value(watch, json.loads(watch.says('"quality": "good"'))["value"])


def wait_for_another_value(watch: Program, value: object) -> None:
    """Another value than this one comes."""
    after = 1
    while json.loads(watch.says("mixer/speed", after=after))["value"] == value:
        after += 1


@pytest.mark.parametrize(
    ("count", "height", "shown"),
    [(3, 4, 3), (3, 3, 1), (22, 12, 10), (22, 23, 22), (22, 22, 20), (2, 1, 0), (0, 5, 0)],
)
def test_a_table_higher_than_the_screen_counts_hidden_rows(
    tmp_path: Path, count: int, height: int, shown: int
) -> None:
    lines = on_a_screen(tmp_path, 200, height, ["7"] * count)
    table = lines[: 1 + shown]
    assert [line.split()[0] for line in table] == ["tag", *(f"mixer/t{n}" for n in range(shown))]
    more = f"{count - shown} more: name the tags you want to see, or enlarge the window"
    assert lines[1 + shown :] == ([more] if count > shown else [])


def test_a_text_of_several_lines_hides_other_rows(tmp_path: Path) -> None:
    lines = on_a_screen(tmp_path, 80, 10, ["some words " * 6] * 6)
    assert len(lines) <= 10
    shown = sum(line.startswith("mixer/t") for line in lines)
    assert 1 <= shown < 6
    assert lines[-1].startswith(f"{6 - shown} more: ")


def on_a_screen(folder: Path, width: int, height: int, values: list[str]) -> list[str]:
    tags = tags_of(folder, {})
    document = {"quality": "good", "time": "2026-11-20T12:00:00.123456Z"}
    rows = [TagRow(f"mixer/t{n}", {"value": value, **document}) for n, value in enumerate(values)]
    screen = Console(width=width, height=height, markup=False, emoji=False, highlight=False)
    with screen.capture() as capture:
        screen.print(fitted(screen, rows, tags))
    return [line.rstrip() for line in capture.get().splitlines()]
