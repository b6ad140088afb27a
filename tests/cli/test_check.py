"""The `check` command."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from gateway.cli.config.check import seconds
from tests.cli.conftest import TAGS
from tests.conftest import Command
from tests.e2e.processes import plc_gateway, vigor_line, write_config
from tests.zenoh_peer import free_endpoint

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_check_prints_the_plan(command: Command, config: Path) -> None:
    done = command("check", config)
    assert done.code == 0
    assert "line hall: " in done.out
    assert "characters a second at 19200 baud" in done.out
    assert "worst write latency" in done.out
    assert "a silent station that returns is seen within" in done.out
    rows = [line.split() for line in done.out.splitlines() if line.startswith("  mixer")]
    assert "Y20" in [row[1] for row in rows]
    assert re.search(r"  mixer: one address without replies darkens others for [\d.]+ s", done.out)
    assert f"{config}: good, 7 tags on 1 line" in done.out
    assert "writing mixer/valve (D7.3) reads the word" in done.err
    assert "warning" not in done.err


def test_check_lists_unsolicited_tags(command: Command) -> None:
    out = command("check", EXAMPLES / "barcode-reader.yaml").out
    assert "line conveyor: no requests at 9600 baud\n  device" in out
    assert "  reader  unsolicited  1" in out


def test_check_warns_of_an_overloaded_line(command: Command, tmp_path: Path) -> None:
    tags = {f"d{i}": {"address": f"D{200 * i}", "every": "20ms"} for i in range(20)}
    lines = {"hall": vigor_line("/dev/ttyUSB9", tags)}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    done = command("check", path)
    assert done.code == 0
    assert "warning: line hall is asked for" in done.err
    assert "of what it can carry at 19200 baud: multiply the intervals by" in done.err


def test_check_says_the_price_of_proofs(command: Command, tmp_path: Path) -> None:
    """Not where replies have numbers."""
    net = {"protocol": "modbus-tcp", "tags": {"level": {"address": "holding:10"}}}
    lines = {
        "hall": vigor_line("/dev/ttyUSB9", {"level": {"address": "D10", "every": "200ms"}}),
        "net": {"port": "tcp://127.0.0.1:502", "devices": {"boiler": net}},
    }
    out = command("check", write_config(tmp_path / "config.yaml", free_endpoint(), lines)).out
    hall, net_ = (part for part in out.split("line ") if part.startswith(("hall: ", "net: ")))
    load, proven = re.findall(r"  load ([\d.]+)% (?:of the wire|after an extra reply)", hall)
    assert float(proven) > 1.5 * float(load)
    assert "after an extra reply" not in net_


@pytest.mark.parametrize(("option", "shown"), [("--blocks", True), ("--no-blocks", False)])
def test_check_shows_every_request_or_none(
    command: Command, config: Path, option: str, shown: bool
) -> None:
    done = command("check", config, option)
    assert ("  device" in done.out) is shown


def test_check_prints_brackets_unchanged(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "[red]plant[/red]"
    folder.mkdir(parents=True)
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(folder / "config.yaml", free_endpoint(), lines)
    assert f"{path}: good, 1 tag on 1 line\n" in command("check", path).out


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "client of nobody": ({"mode": "client", "listen": []}, "name its router in `connect`"),
    "no port": (
        {"listen": ["tcp/foo"]},
        "1: zenoh.listen[0]: 'tcp/foo': write it as tcp/host:port",
    ),
    "twice": ({"listen": ["tcp/[::1]:7447"] * 2}, "1: zenoh.listen: tcp/[::1]:7447 is there twice"),
    "no certificate": ({"listen": ["tls/localhost:7447"]}, "'tls/localhost:7447': it needs a cert"),
    "certificate": (
        {"tls": {"certificate": "text", "key": "text"}},
        "text holds no certificate in PEM form",
    ),
    "no JSON5": ({"config_file": "text"}, "zenoh config_file"),
    "misspelt": ({"config_file": "misspelt"}, "unknown field `acces_control`"),
    "open to all": ({"users_file": "open"}, "open is open to every user of this machine"),
    "no users": ({"users_file": "text"}, "text, line 1: write it as name:password"),
    "writers": ({}, "writers.file"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_check_and_run_refuse_the_same_mistakes_with_2(
    command: Command, tmp_path: Path, mistake: str
) -> None:
    zenoh, says = MISTAKES[mistake]
    for name, text in (("text", "hello\n"), ("misspelt", "{acces_control: {}}"), ("open", "a:b\n")):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o644 if name == "open" else 0o600)
    path = write_config(
        tmp_path / "config.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", TAGS)},
        zenoh={"listen": [free_endpoint()], **zenoh},
        writers={"file": "text"} if mistake == "writers" else None,
    )
    checked = command("check", path)
    assert (checked.code, checked.out) == (2, "")
    assert says in checked.err
    ran = plc_gateway("run", path)
    said = [line for line in ran.err.splitlines() if "gateway starting" not in line]
    assert (ran.code, ran.out, said) == (2, "", checked.err.splitlines())


@pytest.mark.parametrize(
    ("duration", "text"),
    [(0.0123, "12.3 ms"), (0.9994, "999.4 ms"), (1.434, "1.43 s"), (float("inf"), "inf s")],
)
def test_durations_are_formatted(duration: float, text: str) -> None:
    assert seconds(duration) == text


@pytest.mark.parametrize("setting", ["history.path", "gateway.state"])
def test_check_fails_where_the_gateway_cannot_write(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: str
) -> None:
    section, name = setting.split(".")
    path = write_config(
        tmp_path / "config.yaml",
        free_endpoint(),
        {"hall": vigor_line("simulator", TAGS)},
        **{section: {name: "below/file"}},
    )
    before = sorted(tmp_path.iterdir())
    done = command("check", path)
    assert done.code == 1
    folder = tmp_path / "below"
    assert f"error: {setting}: {folder / 'file'} cannot be written: there is no fold" in done.err
    assert "$STATE_DIRECTORY (not set here)" in done.err
    assert ": good" not in done.out
    assert sorted(tmp_path.iterdir()) == before
    state = tmp_path / "state"
    (state / "below").mkdir(parents=True)
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    assert command("check", path).code == 0
    assert list(state.rglob("*")) == [state / "below"]


@pytest.mark.parametrize(
    ("every", "warning"),
    [
        ("8s", "line far never hangs up: its shortest interval is 8 s"),
        ("30s", "line far dials all the time: its shortest interval is 30 s"),
        ("15min", ""),
    ],
)
def test_check_counts_telephone_calls(
    command: Command, tmp_path: Path, every: str, warning: str
) -> None:
    far = vigor_line("modem:/dev/ttyS0", {"level": {"address": "D100", "every": every}})
    far["devices"]["mixer"]["reply_timeout"] = "3s"
    lines = {"far": {**far, "modem": {"number": "26204393"}}}
    done = command("check", write_config(tmp_path / "c.yaml", free_endpoint(), lines))
    text = " ".join(done.out.split())
    assert "line far dials 26204393: a call takes up to 67 s" in text
    assert "the values turn bad after 207 s (3 tries)" in text
    assert warning in done.err
    assert ("warning" in done.err) is bool(warning)


def test_check_says_how_long_a_connection_takes(command: Command, tmp_path: Path) -> None:
    far = vigor_line("tcp://127.0.0.1:4001", {"level": {"address": "D100", "every": "5s"}})
    lines = {"far": {**far, "close_after": "round", "connect_delay": "1500ms"}}
    done = command("check", write_config(tmp_path / "c.yaml", free_endpoint(), lines))
    text = " ".join(done.out.split())
    assert "line far connects for each round and each write: each takes 1.5 s longer" in text


@pytest.mark.parametrize(
    ("ports", "warned"),
    [
        (("/dev/ttyUSB0", "/dev/ttyACM0"), True),
        (("/dev/ttyUSB0", "/dev/ttyS0"), False),  # one adapter keeps its number
        (("/dev/serial/by-id/usb-a", "/dev/serial/by-path/pci-1"), False),
    ],
)
def test_check_warns_of_adapters_that_may_change_places(
    command: Command, tmp_path: Path, ports: tuple[str, str], warned: bool
) -> None:
    lines = {
        f"hall-{number}": {
            "port": port,
            "devices": {
                f"press-{number}": {
                    "protocol": "modbus-rtu",
                    "station": 1,
                    "tags": {"t": {"address": "holding:0"}},
                }
            },
        }
        for number, port in enumerate(ports)
    }
    file = tmp_path / "plant.yaml"
    file.write_text(json.dumps({"lines": lines}))
    said = " ".join(command("check", file).err.split())
    assert ("hall-0 and hall-1: /dev/ttyUSB0 and /dev/ttyACM0 may change places" in said) is warned
