"""The status documents of lines and devices."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.contract import payload
from gateway.contract.status import device_document, standing
from gateway.engine.device.device import Device
from gateway.errors import NoReply
from gateway.line.line import Line
from gateway.plant.plant import Plant
from tests.e2e.processes import vigor_line, write_config

TAGS = {"speed": {"address": "D10"}, "door": {"address": "M12"}}


def made(folder: Path, **device: Any) -> Plant:
    line = vigor_line("simulator", TAGS, **device)
    return Plant(load(write_config(folder / "c.yaml", "tcp/127.0.0.1:7447", {"hall": line})))


def only(gateway: Plant) -> tuple[Line, Device]:
    [line] = gateway.lines
    [device] = line.engine.devices
    return line, device


async def served(gateway: Plant, until: str) -> None:
    """Runs the one line until the document of the device shows this standing."""
    line, device = only(gateway)
    task = asyncio.create_task(line.run())
    async with asyncio.timeout(300):
        while standing(device) != until:
            await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_before_the_first_transaction(tmp_path: Path) -> None:
    documents = made(tmp_path).status()
    assert set(documents) == {"status", "lines/hall", "devices/mixer"}
    status = documents["status"]
    assert (status["name"], status["tags"]) == ("demo", 2)
    assert (status["lines"], status["devices"]) == ({"hall": False}, {"mixer": "starting"})
    device = documents["devices/mixer"]
    assert (device["protocol"], device["station"]) == ("vigor", 1)
    assert (device["exchanges"], device["turnaround"], device["diagnosis"]) == (0, None, "")
    line = documents["lines/hall"]
    assert (line["open"], line["opened"], line["baudrate"]) == (False, 0, 19200)


async def test_transactions_are_counted(tmp_path: Path) -> None:
    gateway = made(tmp_path)
    await served(gateway, "up")
    document = gateway.status()["devices/mixer"]
    assert document["standing"] == "up"
    assert isinstance(document["exchanges"], int)
    assert document["exchanges"] >= 1
    assert document["failures"] == {}


async def test_a_failing_device_has_a_diagnosis(tmp_path: Path) -> None:
    _, device = only(made(tmp_path))
    error = NoReply("no reply")
    device.record.count_failure(error)
    device.health.unclear(error, None, 0.0)
    document = device_document(device, [], 0.0)
    assert document["failures"] == {"silence": 1}
    assert "check power, wiring" in str(document["diagnosis"])


async def test_a_disabled_device_has_no_document_of_its_own(tmp_path: Path) -> None:
    documents = made(tmp_path, enabled=False).status()
    assert set(documents) == {"status", "lines/hall"}
    assert documents["status"]["devices"] == {}


async def test_every_document_is_json(tmp_path: Path) -> None:
    gateway = made(tmp_path)
    await served(gateway, "up")
    for document in gateway.status().values():
        assert json.loads(payload.document(document)).keys() == document.keys()


async def test_a_line_shows_its_forecast(tmp_path: Path) -> None:
    gateway = made(tmp_path)
    line, device = only(gateway)
    expected = gateway.status()["lines/hall"]["expected"]
    load = sum(device.seconds(block.cost) / block.every for block in device.blocks)
    assert isinstance(expected, dict)
    assert expected["load"] == pytest.approx(load, rel=0.01)  # resyncs from time to time
    assert expected["requests_per_second"] == 10  # two blocks, five times a second
    assert line.engine.wire.baudrate == 19200


async def test_the_uptime_does_not_follow_the_wall_clock(tmp_path: Path) -> None:
    wall = [1_800_000_000 * 10**9]
    line = vigor_line("simulator", TAGS)
    config = load(write_config(tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {"hall": line}))
    gateway = Plant(config, wall=lambda: wall[0])
    wall[0] -= 600 * 10**9
    up = gateway.status()["status"]["up"]
    assert isinstance(up, float)
    assert 0 <= up < 60
