"""The progress bar: on a terminal, from the second second on."""

import io
import os
import pty
import subprocess
import sys
import threading
import time
from pathlib import Path

from rich.console import Console

from gateway.cli.progress import AFTER, COUNTED, counted, progress
from tests.e2e.processes import PATIENCE, ROOT

PLANT = """\
zenoh: {listen: [tcp/127.0.0.1:7447]}
lines:
  hall:
    port: simulator
    devices: {plc: {protocol: vigor, station: 1, tags: {a: {address: D1}}}}
"""
# The command itself, with a file that takes as long as the pipe named first is empty.
SLOW = """
import sys
from gateway.cli import main
from gateway.cli.config import check
pipe, load = sys.argv.pop(1), check.load
def slow(file, report=None):
    if report is not None:
        open(pipe).read()
    return load(file, report) if report else load(file)
check.load = slow
main.main()
"""


def test_a_long_check_shows_a_bar_and_removes_it(tmp_path: Path) -> None:
    """Loading takes until the test writes into a pipe."""
    path, pipe = tmp_path / "plant.yaml", tmp_path / "pipe"
    path.write_text(PLANT)
    os.mkfifo(pipe)
    near, far = pty.openpty()
    begun = time.monotonic()
    program = subprocess.Popen(
        [sys.executable, "-c", SLOW, pipe, "check", path],
        stdout=subprocess.PIPE,
        stderr=far,
        cwd=ROOT,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "80"},
        text=True,
    )
    os.close(far)
    shown = b""
    while b"%" not in shown:
        try:
            shown += os.read(near, 1024)
        except OSError:
            out, _ = program.communicate()
            raise AssertionError(f"it ended with {program.returncode}: {shown!r} {out}") from None
    assert time.monotonic() - begun >= AFTER
    assert b"starting" in shown
    pipe.write_text("go on")
    out, _ = program.communicate(timeout=PATIENCE)
    shown += _rest(near)
    assert program.returncode == 0
    assert f"{path}: good, 1 tag on 1 line" in out
    assert "starting" not in out
    assert shown.rstrip().endswith((b"\x1b[2K", b"\x1b[?25h"))  # the row is empty again


def _rest(terminal: int) -> bytes:
    found = b""
    try:
        while more := os.read(terminal, 1024):
            found += more
    except OSError:  # its other end is closed
        pass
    finally:
        os.close(terminal)
    return found


def _console(*, terminal: bool, term: str = "xterm") -> tuple[Console, io.StringIO]:
    text = io.StringIO()
    return Console(file=text, force_terminal=terminal, _environ={"TERM": term}), text


def test_without_a_terminal_there_is_no_bar() -> None:
    console, text = _console(terminal=False)
    before = threading.active_count()
    with progress(console, 0.0) as report:
        assert threading.active_count() == before  # nothing will show it later
        report("reading", 0.5)
    assert text.getvalue() == ""


def test_a_terminal_without_a_cursor_gets_no_bar() -> None:
    console, text = _console(terminal=True, term="dumb")
    with progress(console, 0.0) as report:
        report("reading", 0.5)
    assert text.getvalue() == ""


def test_quick_work_shows_nothing() -> None:
    console, text = _console(terminal=True)
    with progress(console, 1000.0) as report:
        report("reading", 0.5)
    assert text.getvalue() == ""


def test_the_bar_says_what_is_done_and_how_much() -> None:
    console, text = _console(terminal=True)
    with progress(console, 0.0) as report:
        report("reading plant.yaml", 0.5)
        while "50%" not in text.getvalue():  # a thread draws it
            time.sleep(0.01)
    assert "reading plant.yaml" in text.getvalue()


def test_work_of_an_unknown_length_says_how_far_it_is() -> None:
    console, text = _console(terminal=True)
    with progress(console, 0.0) as report:
        report("reading plant.yaml", 1.0)
        assert list(counted(range(2 * COUNTED + 1), "rows exported", report))[-1] == 2 * COUNTED
        while "2,000 rows exported" not in text.getvalue():  # a thread draws it
            time.sleep(0.01)
