"""The commands that `run` proposes."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.run import next_steps, program
from gateway.config import load
from tests.e2e.processes import vigor_line, write_config
from tests.zenoh_peer import free_endpoint


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
def test_the_proposed_write_is_accepted_by_its_tag(
    tmp_path: Path, tag: dict[str, Any], typed: str
) -> None:
    path = write_config(
        tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", {"t": tag})}
    )
    config = load(path)
    steps = next_steps(config, path, "plc-gateway").splitlines()
    [line] = [line for line in steps if line.startswith("  plc-gateway write")]
    assert line == f"  plc-gateway write {path} mixer/t {typed}"
    [made] = config.devices[0].tags
    try:
        value = json.loads(typed)
    except ValueError:
        value = typed
    made.encode(value)


def test_no_write_to_a_real_machine_is_proposed(tmp_path: Path) -> None:
    tags = {"t": {"address": "D1", "write": True}}
    path = write_config(
        tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("/dev/ttyUSB0", tags)}
    )
    steps = next_steps(load(path), path, "plc-gateway")
    assert "plc-gateway read" in steps
    assert "plc-gateway write" not in steps


def test_a_proposed_command_quotes_a_path_with_a_blank(tmp_path: Path) -> None:
    tags = {"t": {"address": "D1"}}
    path = write_config(
        tmp_path / "my plant.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", tags)}
    )
    assert f"plc-gateway watch '{path}'" in next_steps(load(path), path, "plc-gateway")


@pytest.mark.parametrize(
    ("started", "found", "typed"),
    [
        (".venv/bin/plc-gateway", None, ".venv/bin/plc-gateway"),
        ("/usr/bin/plc-gateway", "/usr/bin/plc-gateway", "plc-gateway"),
        ("/x/gateway/__main__.py", None, f"{sys.executable} -m gateway"),
    ],
)
def test_the_proposed_commands_begin_as_this_program_was_started(
    monkeypatch: pytest.MonkeyPatch, started: str, found: str | None, typed: str
) -> None:
    monkeypatch.setattr(sys, "argv", [started])
    monkeypatch.setattr("shutil.which", lambda name: found)
    assert program() == typed


WAITING = """
import atexit, threading
from gateway.cli.run import end_beside_zenoh
atexit.register(print, "Python's own end")
threading.Thread(target=threading.Event().wait, name="zenoh answers", daemon=True).start()
end_beside_zenoh()
"""


def test_a_thread_that_waits_in_zenoh_is_not_ended_by_python() -> None:
    done = subprocess.run([sys.executable, "-c", WAITING], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


HANGING = """
import asyncio, sys, time
from pathlib import Path
from gateway import ending
from gateway.cli.run import serve
from gateway.config import load
from gateway.service import service

async def run(*_arguments):
    asyncio.create_task(asyncio.to_thread(time.sleep, 300))
    await asyncio.sleep(0.1)

service.run, ending.WITHIN = run, 0.5
path = Path(sys.argv[1])
serve(load(path), path, print)
"""


def test_a_thread_that_hangs_does_not_keep_the_gateway_from_its_end(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    config = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    command = [sys.executable, "-c", HANGING, str(config)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 1
    assert "not ended 0.5 s after the signal: the process ends with " in done.stderr
    assert "(most recent call first)" in done.stderr
