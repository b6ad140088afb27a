"""`--direct`: reads and writes without a gateway."""

from pathlib import Path

import pytest

from tests.cli.conftest import TAGS, documents
from tests.e2e.processes import free_port, plc_gateway, vigor_line, write_config
from tests.zenoh_peer import free_endpoint


def test_read_direct(config: Path) -> None:
    done = plc_gateway("read", config, "--direct", "--json")
    rows = documents(done.out)
    assert done.code == 0
    assert [row["tag"] for row in rows] == [f"mixer/{name}" for name in TAGS]
    assert {row["quality"] for row in rows} == {"good"}


@pytest.mark.parametrize("as_json", [False, True])
def test_write_direct(config: Path, as_json: bool) -> None:
    done = plc_gateway(
        "write", config, "mixer/trim", "-5", "--direct", *(["--json"] if as_json else [])
    )
    assert (done.code, done.err) == (0, "")
    if as_json:
        [answer] = documents(done.out)
        assert set(answer) == {"value", "time", "verified", "acknowledged", "took", "origin"}
        assert answer["time"].endswith("Z")
    else:
        assert done.out.startswith("mixer/trim = -5: acknowledged and read back (simulated), ")


def test_direct_reports_why_a_port_cannot_be_opened(tmp_path: Path) -> None:
    port = f"tcp://127.0.0.1:{free_port()}"
    path = write_config(tmp_path / "config.yaml", free_endpoint(), {"hall": vigor_line(port, TAGS)})
    why = f"{port.removeprefix('tcp://')}: connection refused"
    read = plc_gateway("read", path, "--direct", "--json")
    assert read.code == 1
    assert {(row["quality"], row["reason"]) for row in documents(read.out)} == {
        ("bad", "line-down")
    }
    assert read.err == f"mixer: {why}\n"
    write = plc_gateway("write", path, "mixer/trim", "1", "--direct")
    assert (write.code, write.out) == (1, "")
    assert write.err == f"mixer/trim: line-down: {why}\n"


def test_direct_does_not_contact_a_disabled_device(tmp_path: Path) -> None:
    line = vigor_line("simulator", TAGS, enabled=False)
    path = write_config(tmp_path / "config.yaml", free_endpoint(), {"hall": line})
    read = plc_gateway("read", path, "--direct", "--json")
    assert read.code == 1
    assert {row["reason"] for row in documents(read.out)} == {"disabled"}
    write = plc_gateway("write", path, "mixer/trim", "1", "--direct")
    assert write.code == 2
    assert "mixer is disabled" in write.err


def test_direct_does_not_wait_for_a_broadcast_device(tmp_path: Path) -> None:
    """Station 0 of Modbus is a broadcast: it is written to, and never answers."""
    line = {
        "port": "simulator",
        "baudrate": 19200,
        "format": "8E1",
        "devices": {
            "all": {
                "protocol": "modbus-rtu",
                "station": 0,
                "tags": {"stop": {"address": "coil:5", "write": True}},
            }
        },
    }
    path = write_config(tmp_path / "config.yaml", free_endpoint(), {"hall": line})
    read = plc_gateway("read", path, "--direct", "--json")
    assert read.code == 1
    assert [row["quality"] for row in documents(read.out)] == ["bad"]
    write = plc_gateway("write", path, "all/stop", "true", "--direct")
    assert write.code == 0
    assert "broadcast, without acknowledgement" in write.out


@pytest.mark.parametrize("command", [("read",), ("write", "mixer/trim", "1")])
def test_direct_is_refused_beside_the_gateway(running: Path, command: tuple[str, ...]) -> None:
    """A device server would take both connections: two masters on one wire."""
    name, *more = command
    done = plc_gateway(name, running, *more, "--direct")
    assert (done.code, done.out) == (1, "")
    assert done.err == "the gateway of this file runs, and has the ports: leave out --direct\n"
