"""Fixtures of the commands: run in this process, and gateways to talk to."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from tests.e2e.processes import plc_gateway, started, until_exit, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

TAGS = {
    "speed": {"address": "D10", "unit": "rpm"},
    "trim": {"address": "D500", "write": {"min": -5, "max": 40, "verify": True}},
    "offset": {"address": "D501", "scale": 0.5, "write": True},
    "run": {"address": "Y20", "write": True},
    "valve": {"address": "D7.3", "write": True},
    "name": {"address": "D600", "type": "string[128]", "every": "5s", "write": True},
    "level": {"address": "D700", "type": "float32", "write": True},
}


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A file without a running gateway."""
    lines = {"hall": vigor_line("simulator", TAGS)}
    return write_config(tmp_path / "config.yaml", free_endpoint(), lines)


@pytest.fixture(scope="package")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The file of a running gateway with simulated PLCs."""
    folder = tmp_path_factory.mktemp("running")
    lines = {"hall": vigor_line("simulator", TAGS)}
    path = write_config(folder / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device online")
        until_exit(0, plc_gateway, "read", path)
        yield path


@pytest.fixture
def newer(running: Path, tmp_path: Path) -> Path:
    """A newer version of the file, with a tag `mixer/new` that the running gateway lacks."""
    document = json.loads(running.read_text())
    mixer = document["lines"]["hall"]["devices"]["mixer"]
    mixer["tags"]["new"] = {"address": "D900", "write": True}
    path = tmp_path / "newer.yaml"
    path.write_text(json.dumps(document))
    return path


def documents(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def tags_of(folder: Path, tags: dict[str, Any]) -> dict[str, Any]:
    path = write_config(
        folder / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", tags)}
    )
    return {tag.key: tag for device in load(path).devices for tag in device.tags}
