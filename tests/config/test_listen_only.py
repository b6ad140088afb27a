"""`listen_only: true`: the lines that can only listen, and those that cannot."""

from pathlib import Path

import pytest

from gateway.config import ConfigErrors, load


def mistakes(tmp_path: Path, text: str) -> str:
    file = tmp_path / "plant.yaml"
    file.write_text(text)
    with pytest.raises(ConfigErrors) as found:
        load(file)
    return str(found.value)


def test_the_line_and_its_devices_only_listen(tmp_path: Path) -> None:
    file = tmp_path / "plant.yaml"
    file.write_text(
        "lines: {hall: {port: /dev/ttyUSB0, listen_only: true, devices: {meter: {"
        "protocol: modbus-rtu, station: 3, tags: {n: {address: 'holding:0', write: true}}}}}}"
    )
    (line,) = load(file).lines
    assert line.listen_only
    assert [device.listen_only for device in line.devices] == [True]


def test_the_simulator_has_no_other_master(tmp_path: Path) -> None:
    text = (
        "lines: {hall: {port: simulator, listen_only: true, devices: {meter: {"
        "protocol: vigor, tags: {n: {address: D0}}}}}}"
    )
    said = mistakes(tmp_path, text)
    assert "lines.hall.port: listen_only: the simulator has no other master to listen to" in said


def test_frames_of_two_kinds_cannot_be_told_apart(tmp_path: Path) -> None:
    text = (
        "lines: {hall: {port: /dev/ttyUSB0, baudrate: 9600, format: 7E1, listen_only: true, "
        "devices: {a: {protocol: vigor, station: 1, tags: {}}, "
        "b: {protocol: computer-link, station: 2, tags: {}}}}}"
    )
    said = mistakes(tmp_path, text)
    assert "lines.hall.devices.b.protocol" in said
    assert "a has other frames: all devices of such a line have one protocol" in said


def test_a_network_device_is_asked_over_a_connection_of_its_own(tmp_path: Path) -> None:
    text = (
        "lines: {hall: {port: 'tcp://10.0.0.1:502', listen_only: true, "
        "devices: {a: {protocol: modbus-tcp, tags: {}}}}}"
    )
    said = mistakes(tmp_path, text)
    assert "values of modbus-tcp cannot be learned from another master: remove listen_only" in said
