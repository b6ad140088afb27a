"""The address of a gateway, read without the rest of its file."""

import subprocess
import sys
from pathlib import Path

import pytest

from gateway.config import load
from gateway.config.gateway_address import address

ROOT = Path(__file__).parents[2]
LINES = """
lines:
  hall: {port: simulator, devices: {mixer: {protocol: vigor, tags: {a: {address: D1}}}}}
"""
FILES = [ROOT / "config.example.yaml", *sorted((ROOT / "examples").glob("*.yaml"))]


def written(folder: Path, text: str) -> Path:
    path = folder / "plant.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_the_address_is_that_of_the_whole_file(path: Path) -> None:
    found, whole = address(path), load(path)
    assert found is not None
    assert (found.name, found.standby, found.zenoh) == (whole.name, whole.standby, whole.zenoh)


@pytest.mark.parametrize(
    "sections",
    [
        "",
        "gateway: {name: a, standby: hall, standby_alone: 5s, watch_config: true, state: s.json}",
        "zenoh: {prefix: plant/site-1, mode: client, connect: [tcp/a:1, tls/b:2], user: u}",
        "zenoh: {listen: [], connect: [tcp/a:1], refresh: 5min}\ngateway: {name: '1'}",
        "zenoh: {tls: {ca: plant.yaml}, users_file: plant.yaml, config_file: plant.yaml}",
        "gateway: {name: 12, secret_file: plant.yaml, standby: hall}",
    ],
)
@pytest.mark.parametrize("first", [True, False])
def test_every_setting_counts_as_in_the_whole_file(
    tmp_path: Path, sections: str, first: bool
) -> None:
    path = written(tmp_path, f"{sections}\n{LINES}" if first else f"{LINES}{sections}\n")
    found, whole = address(path), load(path)
    assert found is not None
    assert (found.name, found.standby, found.zenoh) == (whole.name, whole.standby, whole.zenoh)


@pytest.mark.parametrize(
    "sections",
    [
        "gateway: {nam: a}",
        "gateway: {name: a b}",
        "gateway: 5",
        "gateway:",
        "gateway: {standby_alone: 5s}",
        "gateway: {watch_config: 1}",
        "zenoh: {mode: server}",
        "zenoh: {user: 5}",
        "zenoh: {tls: {mutual: true}}",
        "zenoh: {tls: {key: plant.yaml}}",
        "zenoh: {tls: {keys: plant.yaml}}",
        "zenoh: {tls: {ca: none.pem}}",
        "zenoh: {refresh: 5}",
        "zenoh: {listen: tcp/127.0.0.1:7447}",
        "zenoh: {users_file: none.txt}",
        "zenoh: {password_file: plant.yaml}",
        "zenoh: {listen: [tcp/a:1]}\nzenoh: {listen: [tcp/a:2]}",
        "zenoh: {listen: [tcp/a:1, tcp/a:1]}",
        "zenoh: [}",
    ],
)
def test_a_mistake_is_left_to_the_check_of_the_whole_file(tmp_path: Path, sections: str) -> None:
    path = written(tmp_path, f"{sections}\n{LINES}")
    assert address(path) is None
    with pytest.raises(ValueError, match=r"plant\.yaml:"):
        load(path)


def test_anchors_are_left_to_the_whole_file(tmp_path: Path) -> None:
    path = written(tmp_path, f"zenoh: {{listen: &here [tcp/127.0.0.1:1]}}\n{LINES}")
    assert address(path) is None
    assert load(path).zenoh.listen == ("tcp/127.0.0.1:1",)


def test_what_follows_the_two_sections_is_not_read(tmp_path: Path) -> None:
    path = written(tmp_path, "zenoh: {prefix: p}\ngateway: {name: a}\nlines: {hall: {port: }")
    found = address(path)
    assert found is not None
    assert (found.name, found.zenoh.prefix) == ("a", "p")


def test_a_file_that_is_not_there_has_no_address(tmp_path: Path) -> None:
    assert address(tmp_path / "none.yaml") is None


def test_a_short_command_does_not_import_pydantic() -> None:
    """It takes a third of the processor time of a `status` call."""
    code = "import sys, gateway.cli.status; print('pydantic' in sys.modules)"
    asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert asked.stdout == "False\n"
