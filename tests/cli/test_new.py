"""The `new` command: what it writes, and what it refuses before anything is sent."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from gateway.cli.config.new import NamedStation, document
from gateway.cli.line.scan import Found
from gateway.config import load
from gateway.protocols.modbus import ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.transport import SerialSettings
from tests.conftest import Command
from tests.e2e.processes import PATIENCE, free_port, station

SERIAL = SerialSettings(19200, "7E1")


def test_the_file_has_comments_and_loads(tmp_path: Path) -> None:
    stations = [
        NamedStation("mixer", Found(SERIAL, Vigor(station=1), {})),
        NamedStation("010", Found(SERIAL, Vigor(station=2), {}, "error 02")),
    ]
    text = document("demo", "hall-1", "/dev/ttyUSB0", stations, "2s")
    path = tmp_path / "plant.yaml"
    path.write_text(text, encoding="utf-8")
    found = load(path)
    assert [device.name for device in found.devices] == ["mixer", "010"]
    assert found.lines[0].serial == SERIAL
    assert "# this gateway's own name in its keys" in text
    assert '"010":   # it sent an error reply: error 02' in text
    assert "every: 2s " in text


def test_behind_a_device_server_the_speed_of_the_wire_is_asked_for() -> None:
    stations = [NamedStation("mixer", Found(None, Vigor(station=1), {}))]
    assert "    # baudrate: 19200  " in document("demo", "hall-1", "tcp://h:4001", stations)
    known = document("demo", "hall-1", "tcp://h:4001", stations, baud="9600")
    assert "    baudrate: 9600   #" in known
    network = [NamedStation("boiler", Found(None, ModbusTcp(station=1), {}))]
    assert "baudrate" not in document("demo", "hall-1", "tcp://h:502", network)


def test_mistakes_are_found_before_the_line_is_scanned(command: Command, tmp_path: Path) -> None:
    there, absent = tmp_path / "there.yaml", tmp_path / "absent.yaml"
    there.write_text("# mine\n")
    port = ["--port", "/dev/ttyS-none", "--protocol", "vigor"]
    for arguments, problem in (
        ([there, *port], "exists already"),
        ([absent], "--port is missing, and there is no terminal to ask at"),
        ([absent, "--port", "/dev/ttyS-none"], "--protocol is missing"),
        ([absent, *port, "--every", "5"], "is no duration"),
        ([absent, *port, "--name", "my plant"], "has a space"),
        ([absent, *port, "--stations", "x"], "is no number"),
    ):
        done = command("new", *arguments)
        assert (done.code, problem in done.err) == (2, True), done
    assert there.read_text() == "# mine\n"
    assert not absent.exists()


def test_it_asks_on_a_terminal_and_names_the_mistakes_of_the_sheet(tmp_path: Path) -> None:
    """The whole dialogue at a real terminal: a wrong file name, then a sheet with a mistake."""
    (tmp_path / "tags.csv").write_text("Name,Address\nspeed,D100\nlevel,D99999\n")
    number = free_port()
    path = tmp_path / "plant.yaml"
    answers = [f"tcp://127.0.0.1:{number}", "vigor", "", "hall-2", "all", "mixer", "tag.csv"]
    answers.append(str(tmp_path / "tags.csv"))
    slow = ["--stations", "1", "--timeout", "10s"]  # for a slow machine
    with station("tcp", str(number)):
        said, code = at_a_terminal([*answers], "new", path, *slow)
    assert code == 2
    assert "Stations found: 1. Use [all]: " in said
    assert "there is no file tag.csv" in said
    assert "tags.csv: row 3, column B (Address): D99999" in said
    assert "one mistake: nothing was written" in said
    assert f"plc-gateway import {tmp_path / 'tags.csv'} --into {path} --device mixer" in said
    found = load(path)
    assert [line.name for line in found.lines] == ["hall-2"]
    assert [(device.name, device.tags) for device in found.devices] == [("mixer", ())]


def at_a_terminal(answers: list[str], *arguments: object) -> tuple[str, int]:
    """Returns the output of a command that asks, and its exit code."""
    terminal, inner = os.openpty()
    command = [sys.executable, "-m", "gateway", *map(str, arguments)]
    wide = {**os.environ, "COLUMNS": "500"}
    with subprocess.Popen(command, stdin=inner, stdout=inner, stderr=inner, env=wide) as process:
        os.close(inner)
        said, seen = b"", 0
        with suppress(OSError):  # the end of a pty, on Linux
            while data := os.read(terminal, 65536):
                said += data
                if answers and said[seen:].endswith(b": "):
                    seen = len(said)
                    os.write(terminal, answers.pop(0).encode() + b"\n")
        os.close(terminal)
        code = process.wait(PATIENCE)
    return said.decode().replace("\r\n", "\n"), code
