"""The commands `status` and `health`."""

import copy
import io
import re
import signal
import socket
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from gateway.cli.status import view
from gateway.contract.faults import faults, warnings
from gateway.contract.line_faults import span
from tests.conftest import Command
from tests.e2e.processes import (
    gateway,
    plc_gateway,
    started,
    until_exit,
    vigor_line,
    write_config,
)
from tests.web.serving import calling, transfer
from tests.zenoh_peer import free_endpoint

TO_MIXER = {"from": "mixer/a", "to": "mixer:D1..D9"}


def device_on(port: str, name: str) -> dict[str, Any]:
    line = vigor_line(port, {"level": {"address": "D10"}}, reply_timeout="50ms", retries=0)
    return {**line, "devices": {name: line["devices"]["mixer"]}}


def test_a_healthy_gateway(command: Command, running: Path) -> None:
    done = command("status", running)
    assert (done.code, done.err) == (0, "")
    assert re.search(r"^demo \S+, up \d+ (s|min), 7 tags$", done.out, re.MULTILINE)
    assert re.search(r"^hall +simulated +\d", done.out, re.MULTILINE)
    assert re.search(r"^mixer +hall +up +\d+ ms", done.out, re.MULTILINE)
    assert re.search(r"^Zenoh +\d client", done.out, re.MULTILINE)
    assert re.search(r"^history +not kept", done.out, re.MULTILINE)
    assert "wrong" not in done.out
    assert command("health", "--strict", running).code == 0


def test_as_json_it_is_every_document(command: Command, running: Path) -> None:
    documents = command("status", "--json", running).json
    assert documents["status"]["devices"] == {"mixer": "up"}
    assert documents["lines/hall"]["open"] is True
    assert documents["devices/mixer"]["station"] == 1


def test_what_is_wrong_is_said_and_fails(command: Command, tmp_path: Path) -> None:
    with ExitStack() as stack:
        deaf = stack.enter_context(socket.create_server(("127.0.0.1", 0)))  # accepts, says nothing
        lines = {
            "hall": vigor_line("simulator", {"trim": {"address": "D500", "write": True}}),
            "yard": device_on(str(tmp_path / "no-port"), "oven"),
            "roof": device_on(f"tcp://127.0.0.1:{deaf.getsockname()[1]}", "pump"),
        }
        history = {"path": str(tmp_path / "h.db")}
        config = write_config(tmp_path / "c.yaml", free_endpoint(), lines, history=history)
        program = stack.enter_context(started(config))
        program.says("device offline", "pump")
        until_exit(0, command, "write", config, "mixer/trim", "5")
        done = until_exit(1, command, "status", config)
        assert f"line yard is down: {tmp_path / 'no-port'}: no such port" in done.out
        assert re.search(r"pump is silent: .*power", done.out)
        assert "oven" not in done.out[done.out.index("wrong:") :]  # its line says why
        assert re.search(r"^writes +1 written in the last hour", done.out, re.MULTILINE)
        strict = command("health", "--strict", "--json", config)
        assert strict.code == 1
        assert strict.json["devices"]["mixer"] == "up"
        assert strict.err.splitlines()[0].startswith("line yard is down:")
        assert command("health", config).code == 0  # it is there


def test_watch_follows_and_shows_a_gateway_that_has_gone(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"level": {"address": "D10"}})}
    config = write_config(tmp_path / "c.yaml", free_endpoint(), lines)
    with started(config) as program, gateway("status", "--watch", config) as watch:
        watch.says("mixer", "up")
        program.end(signal.SIGKILL)
        watch.says("no reply: is the gateway of this file running?")
        assert watch.end(signal.SIGINT) == 0


@pytest.fixture(scope="module")
def healthy(running: Path) -> dict[str, Any]:
    for _ in range(50):  # on a busy machine a reply may have been late just now
        found: dict[str, Any] = plc_gateway("status", "--json", running).json
        if not any(each.get("diagnosis") for each in found.values()):
            return found
    raise AssertionError("a device stays in trouble")


def changed(healthy: dict[str, Any], path: str, **fields: object) -> dict[str, Any]:
    documents = copy.deepcopy(healthy)
    documents.setdefault(path, {}).update(fields)
    return documents


def test_history_that_is_not_written_is_a_fault(healthy: dict[str, Any]) -> None:
    full = changed(healthy, "history", state="the disk is full", waiting=3, lost=2)
    assert list(faults(full)) == ["history: the disk is full"]
    assert "history: samples lost since the start: 2" in list(warnings(full))


@pytest.mark.parametrize(
    ("path", "fields", "says"),
    [
        ("devices/mixer", {"diagnosis": "Answers twice"}, "mixer: Answers twice"),
        ("devices/mixer", {"refused_addresses": ["D9 of mixer: refused"]}, "D9 of mixer: refused"),
        ("lines/hall", {"expected": {"load": 1.84}}, "line hall: asked for 1.8 times what"),
        ("status", {"refused_devices": {"oven": "other"}}, "oven is served by another gateway"),
    ],
)
def test_what_is_no_fault_is_told(
    healthy: dict[str, Any], path: str, fields: dict[str, Any], says: str
) -> None:
    documents = changed(healthy, path, **fields)
    assert list(faults(documents)) == []
    [sentence] = warnings(documents)
    assert sentence.startswith(says)


def text_of(documents: dict[str, Any], width: int = 100) -> str:
    screen = Console(width=width, record=True, file=io.StringIO())
    screen.print(view(documents, None))
    return screen.export_text()


def test_a_transfer_that_does_not_work_is_a_fault(healthy: dict[str, Any]) -> None:
    refused = transfer("refused", **TO_MIXER, why="251 is more than 250", last_carried=75.0)
    documents = changed(healthy, "transfers/10", **refused)
    documents["transfers/2"] = {**transfer("carried", **TO_MIXER), "last_carried": 3.0}
    [said] = faults(documents)
    assert said == "transfer 10 (mixer/a to mixer:D1..D9) is refused: 251 is more than 250"
    text = text_of(documents)
    assert re.search(r"^2 +mixer/a .* 3 s ago", text, re.MULTILINE)
    assert re.search(r"^10 +mixer/a .*refused .* 1 min ago", text, re.MULTILINE)
    assert text.index("\n2 ") < text.index("\n10 ")
    assert "calls" not in text  # it has no modem


def test_transfers_of_a_silent_device_do_not_hide_it(healthy: dict[str, Any]) -> None:
    documents = changed(healthy, "devices/mixer", standing="silent", diagnosis="No byte came back")
    stale = transfer("stale", **TO_MIXER, why="mixer/a is bad: no-reply")
    documents |= {f"transfers/{number}": stale for number in range(1, 13)}
    assert list(faults(documents)) == ["mixer is silent: No byte came back"]
    [said] = warnings(documents)
    assert said == "transfers 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 and 2 more wait for mixer"
    documents = changed(
        healthy, "transfers/1", **transfer("stale", **{"from": "oven/a", "to": "mixer/b"})
    )
    assert list(faults(documents)) == []
    assert list(warnings(documents)) == ["transfer 1 waits for oven"]  # it is not enabled


def test_the_programs_at_a_door_are_shown(healthy: dict[str, Any]) -> None:
    program = {"address": "10.1.0.7", "since": 61.0, "requests": 12, "writes": 3, "refused": 1}
    door = {"line": "hall", "trouble": "", "share": 0.12, "programs": [program]}
    documents = changed(healthy, "doors/laptop", **door)
    assert re.search(
        r"laptop +hall +12 % of the wire +10\.1\.0\.7 +1 min +12 +3 +1", text_of(documents)
    )
    documents = changed(healthy, "doors/laptop", **{**door, "programs": [], "trouble": "in use"})
    assert list(faults(documents)) == ["door laptop to line hall is closed: in use"]
    assert "-" in text_of(documents)


def test_a_doubtful_line_is_shown_with_the_load_of_its_proofs(healthy: dict[str, Any]) -> None:
    documents = changed(healthy, "lines/hall", expected={"load": 0.12, "load_proven": 0.34})
    documents["status"]["simulated"] = []
    assert re.search(r"^hall +open .* 12 % ", text_of(documents), re.MULTILINE)
    documents["lines/hall"]["doubtful"] = True
    assert re.search(r"^hall +doubtful .* 34 % ", text_of(documents), re.MULTILINE)


def test_the_calls_of_a_modem_are_shown(healthy: dict[str, Any]) -> None:
    documents = changed(healthy, "lines/hall", calls=calling()["calls"])
    assert list(faults(documents)) == []
    said = "line hall: the last call failed: modem:/dev/ttyS0: BUSY"
    assert list(warnings(documents)) == [said]
    assert re.search(
        r"^hall +idle +4 s +in 14 min +BUSY +7 +2 *$", text_of(documents, 80), re.MULTILINE
    )


def test_control_characters_of_a_device_do_not_reach_the_terminal(healthy: dict[str, Any]) -> None:
    evil = changed(healthy, "devices/mixer", standing="silent", diagnosis="a\x1b[2Jb\nc")
    screen = Console(width=200, record=True, file=io.StringIO())
    screen.print(view(evil, None))
    shown = screen.export_text()
    assert "\x1b" not in shown
    assert r"a\x1b[2Jb\nc" in shown


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (59.9, "60 s"),
        (61, "1 min"),
        (3600, "1 h 0 min"),
        (93600, "1 d 2 h"),
    ],
)
def test_a_span_of_time(seconds: float, text: str) -> None:
    assert span(seconds) == text


def test_a_lost_router_is_said() -> None:
    documents: dict[str, Any] = {"zenoh": {"connect": ["tcp/10.0.0.1:7447"], "to": ["client"]}}
    said = "Zenoh: not connected to tcp/10.0.0.1:7447: its clients get no values"
    assert list(faults(documents)) == [said]
    for to in ("router", "peer"):
        documents["zenoh"]["to"] = ["client", to]
        assert list(faults(documents)) == []


def test_a_jump_of_the_clock_is_said_for_an_hour() -> None:
    documents: dict[str, Any] = {"status": {"refused_devices": {}}}
    documents["clock"] = {"jumps": 1, "last": -600.0, "ago": 61.0}
    [said] = warnings(documents)
    assert said.startswith("the clock of this machine jumped by -600.0 s 1 min ago")
    documents["clock"]["ago"] = 3601.0
    assert list(warnings(documents)) == []


def stations(healthy: dict[str, Any], number: int, **fields: object) -> dict[str, Any]:
    """Documents of a line with so many equal devices beside the one that replies."""
    documents = copy.deepcopy(healthy)
    for each in range(1, number + 1):
        documents[f"devices/m{each}"] = {**documents["devices/mixer"], **fields}
        documents["lines/hall"]["devices"][f"m{each}"] = "silent"
    return documents


GARBLED = {"lately": {"requests": 32, "failed": {"noise": 24, "silence": 3}}, "diagnosis": "Noise"}


def test_one_cause_on_one_line_is_one_fault(healthy: dict[str, Any]) -> None:
    past = {"silent_for": 754.0, "silences": 3}
    documents = stations(healthy, 32, standing="silent", **GARBLED, **past)
    [said] = faults(documents)
    assert said == (
        "line hall: 32 of 33 devices are silent, no frame to 75% of the last 1024 requests: Noise "
        "(for 12 min, 3 times in 24 h): m1, m2, m3, m4, m5 and 27 more"
    )
    assert list(warnings(documents)) == []
    dead = {"lately": {"requests": 32, "failed": {"silence": 32}}, "diagnosis": "No byte"}
    documents["devices/m2"].update(dead)
    assert len(list(faults(documents))) == 2  # another cause
    documents = stations(healthy, 2, **GARBLED)
    assert list(warnings(documents)) == [
        "line hall, 2 devices, no frame to 75% of the last 64 requests: Noise: m1, m2"
    ]


def test_a_healthy_standby_has_no_fault(healthy: dict[str, Any]) -> None:
    documents = changed(healthy, "lines/hall", open=False, trouble="", down_for=None, losses=0)
    assert list(faults(documents)) == ["line hall is down: not opened yet"]
    standby = {"group": "hall", "stand": "waiting", "others_active": ["a"], "others_waiting": []}
    documents["standby"] = standby
    assert list(faults(documents)) == []
    assert list(warnings(documents)) == []


def test_an_active_gateway_without_a_standby_says_so(healthy: dict[str, Any]) -> None:
    standby = {"group": "hall", "stand": "active", "others_active": []}
    healthy["standby"] = {**standby, "others_waiting": ["b"]}
    assert list(warnings(healthy)) == []
    healthy["standby"] = {**standby, "others_waiting": []}
    assert list(warnings(healthy)) == [
        "no other gateway of group hall waits: none takes over when this one fails"
    ]
