"""The `doctor` command: what of this computer keeps a file from running."""

import json
import os
import socket
from pathlib import Path
from typing import Any

from tests.conftest import Command
from tests.e2e.processes import free_port, vigor_line, write_config
from tests.transport.authority import DAY, Authority
from tests.transport.ends import PtyMaster
from tests.transport.test_tls import foreign_server, serving
from tests.zenoh_peer import free_endpoint

TAGS = {"speed": {"address": "D10", "history": True}}


def found(command: Command, file: Path) -> tuple[int, dict[str, tuple[str, str, str]]]:
    """Returns the exit code and the findings: state, sentence and remedy by what was looked at."""
    done = command("doctor", file, "--json")
    rows = [json.loads(line) for line in done.out.splitlines()]
    return done.code, {row["what"]: (row["state"], row["says"], row["mend"]) for row in rows}


def plant(folder: Path, lines: dict[str, Any], **sections: Any) -> Path:
    return write_config(folder / "plant.yaml", free_endpoint(), lines, **sections)


def on_line(name: str, port: str) -> dict[str, Any]:
    made = vigor_line(port, TAGS)
    made["devices"] = {name: next(iter(made["devices"].values()))}
    return made


def test_each_port_has_its_state_and_its_remedy(command: Command, tmp_path: Path) -> None:
    free, no_port = free_port(), tmp_path / "ttyUSB9"
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
        lines = {
            "open": on_line("d1", f"tcp://127.0.0.1:{number}"),
            "closed": on_line("d2", f"tcp://127.0.0.1:{free}"),
            "taken": on_line("d3", f"listen://127.0.0.1:{number}"),
            "gone": on_line("d4", str(no_port)),
            "file": on_line("d5", f"modem:{__file__}") | {"modem": {"number": "1"}},
        }
        code, rows = found(command, plant(tmp_path, lines, history={}))
    assert code == 1
    assert rows[f"line open, 127.0.0.1:{number}"] == ("good", "can be connected to", "")
    closed = ("bad", "connection refused", "ping 127.0.0.1")
    assert rows[f"line closed, 127.0.0.1:{free}"] == closed
    assert rows[f"line taken, 127.0.0.1:{number}"][:2] == (
        "bad",
        "this address is in use by another program",
    )
    assert rows[f"line gone, {no_port}"][:2] == ("bad", "no such port")
    assert rows[f"line file, {__file__}"][:2] == ("bad", "not a serial port")
    state, says, mend = rows["gateway demo"]
    assert (state, mend.partition(" /")[0]) == ("look", "plc-gateway run")
    assert "no gateway at" in says


def test_a_certificate_that_is_refused_is_said(command: Command, tmp_path: Path) -> None:
    plant_of_it = Authority(tmp_path / "pki")
    late = foreign_server(*plant_of_it.issue("late", left=-DAY))
    with serving(late) as number:
        line = on_line("d1", f"tls://127.0.0.1:{number}") | {"tls": {"ca": "pki/ca.pem"}}
        code, rows = found(command, plant(tmp_path, {"hall": line}, history={}))
    state, says, _ = rows[f"line hall, 127.0.0.1:{number}"]
    assert (code, state) == (1, "bad")
    assert says == "its certificate has expired: renew it there, or correct the clock here"


def test_a_serial_port_that_another_program_has_open_is_said(
    command: Command, tmp_path: Path
) -> None:
    plug = PtyMaster()
    try:
        file = plant(tmp_path, {"hall": vigor_line(plug.path, TAGS)}, history={})
        code, rows = found(command, file)
        assert code == 1
        state, says, _ = rows[f"line hall, {plug.path}"]
        assert state == "bad"
        assert f"process {os.getpid()} (" in says
    finally:
        plug.unplug()


def test_a_history_larger_than_the_disk_is_said(command: Command, tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", TAGS)}
    code, rows = found(command, plant(tmp_path, lines, history={"max_size": "900000TB"}))
    [(state, says, mend)] = [row for what, row in rows.items() if what.startswith("disk of")]
    assert (code, state) == (1, "bad")
    assert "history may grow by 900000000.0 GB" in says
    assert mend.startswith("history: {max_size: ")


def test_a_running_gateway_keeps_its_ports(command: Command, running: Path) -> None:
    done = command("doctor", running)
    assert done.code == 0, done
    assert "runs, version" in done.out
    assert f"good  {running}" in done.out
