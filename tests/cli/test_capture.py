"""Captures of a line: Wireshark's own program reads them."""

import os
import subprocess
from pathlib import Path

import pytest

from gateway.cli.line.capture import Capture
from gateway.config import LineConfig, load
from gateway.errors import GatewayError
from tests.conftest import needs
from tests.e2e.processes import PATIENCE

RTU = {"port": "/dev/ttyUSB0", "devices": {"plc": {"protocol": "modbus-rtu", "station": 3}}}
TCP = {"port": "tcp://10.0.0.7:502", "devices": {"plc": {"protocol": "modbus-tcp", "station": 1}}}
VIGOR = {"port": "/dev/ttyUSB0", "devices": {"plc": {"protocol": "vigor", "station": 1}}}
REQUEST, REPLY = "03 03 80 64 00 01 ed f7", "03 03 02 00 1a 40 4f"  # of a recording


def line_of(folder: Path, line: object) -> LineConfig:
    file = folder / "plant.yaml"
    file.write_text(repr({"lines": {"hall": line}}))
    return load(file).lines[0]


def shown(folder: Path, line: object, *pieces: tuple[float, str, str]) -> list[list[str]]:
    """Returns the time, the protocol and the direction and text of each packet in Wireshark."""
    file = folder / "hall.pcapng"
    with Capture(file, line_of(folder, line)) as capture:
        for at, way, data in pieces:
            capture.add(at, way, bytes.fromhex(data))
    columns = ("frame.time_epoch", "_ws.col.Protocol", "_ws.col.Info")
    fields = [option for column in columns for option in ("-e", column)]
    done = subprocess.run(
        [needs("tshark"), "-r", str(file), "-T", "fields", *fields],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE,
    )
    return [row.split("\t") for row in done.stdout.splitlines()]


def test_wireshark_decodes_modbus_rtu_from_pieces(tmp_path: Path) -> None:
    pieces = [(5.25, ">", REQUEST), (5.27, "<", REPLY[:8]), (5.28, "<", REPLY[9:])]
    query, response = shown(tmp_path, RTU, *pieces)
    assert query[0].startswith("5.250000")
    assert "Modbus RTU" in query[1]
    assert "Query: Unit:   3, Func:   3: Read Holding Registers" in query[2]
    assert response[0].startswith("5.270000")
    assert "Response: Unit:   3, Func:   3: Read Holding Registers" in response[2]


def test_wireshark_finds_the_direction_on_a_line_that_only_listens(tmp_path: Path) -> None:
    query, response = shown(tmp_path, RTU, (5.0, "<", REQUEST), (5.02, "<", REPLY))
    assert ("Query" in query[2], "Response" in response[2]) == (True, True)


def test_wireshark_decodes_modbus_tcp(tmp_path: Path) -> None:
    """The frames of a recording."""
    request, reply = "01 0f 00 00 00 06 01 03 00 64 00 01", "01 0f 00 00 00 05 01 03 02 01 ca"
    query, response = shown(tmp_path, TCP, (5.0, ">", request), (5.01, "<", reply))
    assert "Modbus/TCP" in query[1]
    assert "Query: Trans:   271; Unit:   1, Func:   3: Read Holding Registers" in query[2]
    assert "Response: Trans:   271; Unit:   1" in response[2]


def test_the_bytes_of_other_protocols_are_kept(tmp_path: Path) -> None:
    assert len(shown(tmp_path, VIGOR, (5.0, ">", "02 30 31"), (5.1, "<", "06 30"))) == 2


def test_a_full_disk_leaves_a_capture_that_can_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "hall.pcapng"
    with Capture(file, line_of(tmp_path, RTU)) as capture:
        capture.add(5.0, ">", bytes.fromhex(REQUEST))
        size, write = file.stat().st_size, os.write

        def full(number: int, data: bytes) -> int:
            if file.stat().st_size > size:
                raise OSError(28, "No space left on device")
            return write(number, data[:20])

        monkeypatch.setattr(os, "write", full)
        with pytest.raises(GatewayError, match="No space left on device; the gateway goes on"):
            capture.add(5.1, ">", bytes.fromhex(REQUEST))
        assert file.stat().st_size == size
