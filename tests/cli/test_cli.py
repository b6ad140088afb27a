"""The command line: what is printed where, and with which exit code. People see no traceback."""

import json
import os
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from gateway import __version__
from gateway.cli.client import connected
from gateway.cli.main import main
from gateway.config import load, schema
from gateway.errors import GatewayError
from tests.e2e.processes import (
    PATIENCE,
    Done,
    Program,
    free_port,
    gateway,
    plc_gateway,
    started,
    station,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import free_endpoint

EXAMPLES = Path(__file__).parents[2] / "examples"

COMMANDS = [
    *("run", "check", "read", "write", "control", "watch", "scan", "simulate"),
    *("health", "schema", "version"),
]
TAGS = {
    "speed": {"address": "D10", "unit": "rpm"},
    "trim": {"address": "D500", "write": {"min": -5, "max": 40, "verify": True}},
    "offset": {"address": "D501", "scale": 0.5, "write": True},
    "run": {"address": "Y20", "write": True},
    "valve": {"address": "D7.3", "write": True},
    "name": {"address": "D600", "type": "string[128]", "every": "5s", "write": True},
    "level": {"address": "D700", "type": "float32", "write": True},
}
Command = Callable[..., Done]


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """`plc-gateway` in this process, for commands that start nothing."""

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["plc-gateway", *map(str, arguments)])
        try:
            main()
            code: Any = 0
        except SystemExit as end:
            code = end.code or 0
        out, err = capsys.readouterr()
        return Done(code, out, err)

    return run


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Nobody runs it."""
    lines = {"hall": vigor_line("simulator", TAGS)}
    return write_config(tmp_path / "config.yaml", free_endpoint(), lines)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A gateway runs it, with simulated PLCs."""
    folder = tmp_path_factory.mktemp("running")
    lines = {"hall": vigor_line("simulator", TAGS)}
    path = write_config(folder / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device answers")
        while plc_gateway("read", path).code:
            pass  # the first values are on their way
        yield path


def documents(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


# -- help and usage ----------------------------------------------------------------------------


def test_help_names_every_command(command: Command) -> None:
    done = command("--help")
    assert done.code == 0
    assert all(f"\n  {name} " in done.out for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_helps(command: Command, name: str) -> None:
    done = command(name, "--help")
    assert done.code == 0
    assert f"plc-gateway {name}" in done.out
    assert "--help" in done.out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "Usage"),
        (["fly"], "No such command 'fly'"),
        (["check"], "Missing argument 'CONFIG'"),
        (["read", "a.yaml", "--fast"], "No such option"),
        (["run", "a.yaml", "--log-format", "xml"], "xml"),
        (["write", "a.yaml", "mixer/trim"], "Missing argument 'VALUE'"),
    ],
)
def test_wrong_usage_ends_with_2(command: Command, arguments: list[str], says: str) -> None:
    done = command(*arguments)
    assert done.code == 2
    assert says in done.err + done.out


@pytest.mark.parametrize(
    ("name", *("more",)),
    [
        ("run", []),
        ("check", []),
        ("read", []),
        ("write", ["mixer/trim", "1"]),
        ("control", ["mixer", "stop"]),
        ("watch", []),
        ("simulate", []),
        ("health", []),
    ],
)
def test_a_bad_file_ends_every_command_with_2(
    command: Command, tmp_path: Path, name: str, more: list[str]
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("lines: {hall: {port: simulator, devices: {mixer: {protocol: vigour}}}}\n")
    done = command(name, path, *more)
    assert done.code == 2
    assert done.err.startswith(f"{path}:1: lines.hall.devices.mixer.protocol: 'vigour'")
    assert "did you mean vigor?" in done.err
    assert done.out == ""


@pytest.mark.parametrize("name", ["run", "check", "read", "simulate"])
def test_a_file_that_is_not_there_ends_with_2(command: Command, tmp_path: Path, name: str) -> None:
    done = command(name, tmp_path / "none.yaml")
    assert done.code == 2
    assert done.err == f"{tmp_path / 'none.yaml'}: there is no such file\n"


def test_a_folder_is_no_file(command: Command, tmp_path: Path) -> None:
    done = command("check", tmp_path)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1


# -- schema, version, check --------------------------------------------------------------------


def test_schema_prints_the_schema(command: Command) -> None:
    done = command("schema")
    assert (done.code, json.loads(done.out)) == (0, schema())


def test_version(command: Command) -> None:
    assert command("version") == Done(0, f"{__version__}\n", "")


def test_check_prints_the_plan(command: Command, config: Path) -> None:
    done = command("check", config)
    assert done.code == 0
    assert "line hall: " in done.out
    assert "characters a second at 19200 baud" in done.out
    assert "worst write latency" in done.out
    rows = [line.split() for line in done.out.splitlines() if line.startswith("  mixer")]
    assert "Y20" in [row[1] for row in rows]
    assert f"{config}: good, 7 tags on 1 line" in done.out
    assert "writing mixer/valve (D7.3) reads the word" in done.err
    assert "warning" not in done.err


def test_check_tells_what_comes_unasked(command: Command) -> None:
    out = command("check", EXAMPLES / "barcode-reader.yaml").out
    assert "line conveyor: nothing is asked at 9600 baud\n  device" in out
    assert "  reader  comes unasked  1" in out


def test_check_warns_of_a_line_that_is_asked_too_much(command: Command, tmp_path: Path) -> None:
    tags = {f"d{i}": {"address": f"D{200 * i}", "every": "20ms"} for i in range(20)}
    lines = {"hall": vigor_line("/dev/ttyUSB9", tags)}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    done = command("check", path)
    assert done.code == 0
    assert "warning: line hall is asked for" in done.err
    assert "of what it can carry at 19200 baud: multiply the intervals by" in done.err


@pytest.mark.parametrize(("option", "shown"), [("--blocks", True), ("--no-blocks", False)])
def test_check_shows_every_request_or_none(
    command: Command, config: Path, option: str, shown: bool
) -> None:
    done = command("check", config, option)
    assert ("  device" in done.out) is shown


def test_check_leaves_brackets_alone(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "[red]plant[/red]"
    folder.mkdir(parents=True)
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(folder / "config.yaml", free_endpoint(), lines)
    assert f"{path}: good, 1 tag on 1 line\n" in command("check", path).out


MISTAKES: dict[str, tuple[dict[str, Any], str]] = {
    "client of nobody": ({"mode": "client", "listen": []}, "say in `connect` which router"),
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
    "open to all": ({"users_file": "open"}, "open is open to everybody on this machine"),
    "no users": ({"users_file": "text"}, "text, line 1: write it as name:password"),
    "writers": ({}, "writers.file"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_check_says_what_run_would_refuse_and_both_end_with_2(
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
    assert plc_gateway("run", path) == checked


# -- read, write, watch: mistakes of the user --------------------------------------------------


@pytest.mark.parametrize("name", ["read", "watch"])
@pytest.mark.parametrize("direct", [[], ["--direct"]])
@pytest.mark.parametrize(
    ("tag", "says"),
    [
        ("mixer/sped", "there is no tag or device mixer/sped"),
        ("oven", "there is no tag or device oven"),
        ("oven/**", "there is no tag or device oven/**"),
        ("mixer/**/", "mixer/**/ is no tag, and no wildcard such as 'mixer/**'"),
        ("mixer/speed?max_age=0s", "is no tag"),
    ],
)
def test_an_unknown_tag_ends_with_2(
    command: Command, config: Path, name: str, direct: list[str], tag: str, says: str
) -> None:
    if name == "watch" and direct:
        direct = []
    done = command(name, config, tag, *direct)
    assert (done.code, done.out) == (2, "")
    assert says in done.err


def test_max_age_that_is_no_duration_ends_with_2(command: Command, config: Path) -> None:
    done = command("read", config, "--max-age", "soon")
    assert (done.code, done.out) == (2, "")
    assert "max_age=soon is no duration" in done.err


@pytest.mark.parametrize("direct", [[], ["--direct"]])
@pytest.mark.parametrize(
    ("tag", "value", "says"),
    [
        ("mixer/sped", "1", "there is no tag mixer/sped"),
        ("mixer/speed", "1", "mixer/speed cannot be written"),
        ("mixer/trim", "41", "mixer/trim: 41 is above the greatest value 40"),
        ("mixer/trim", "-6", "mixer/trim: -6 is below the least value -5"),
        ("mixer/trim", "1.5", "mixer/trim: 1.5"),
        ("mixer/trim", "[/b]", "mixer/trim: "),
        ("mixer/run", "maybe", "mixer/run: "),
    ],
)
def test_a_write_that_cannot_be_ends_with_2(
    command: Command, config: Path, direct: list[str], tag: str, value: str, says: str
) -> None:
    done = command("write", config, tag, value, *direct)
    assert (done.code, done.out) == (2, "")
    assert says in done.err
    assert len(done.err.splitlines()) == 1


@pytest.mark.parametrize(
    "arguments", [["read"], ["write", "mixer/trim", "1"], ["watch"], ["health"]]
)
def test_no_gateway_runs(config: Path, arguments: list[str]) -> None:
    name, *more = arguments
    done = plc_gateway(name, config, *more)
    assert (done.code, done.out) == (1, "")
    assert "no gateway at tcp/127.0.0.1:" in done.err
    assert "start it with `plc-gateway run`, or use --direct" in done.err
    assert len(done.err.splitlines()) == 1


# -- through the running gateway ---------------------------------------------------------------


def test_read_prints_a_table(running: Path) -> None:
    done = plc_gateway("read", running)
    assert done.code == 0
    header, *rows = done.out.splitlines()
    assert header.split() == ["tag", "value", "unit", "quality", "time"]
    assert [row.split()[0] for row in rows] == sorted(f"mixer/{name}" for name in TAGS)
    assert [row.split()[2:4] for row in rows if row.startswith("mixer/speed")] == [["rpm", "good"]]


def test_read_as_json_is_one_document_a_line(running: Path) -> None:
    text = "x" * 128  # a line longer than any terminal
    assert plc_gateway("write", running, "mixer/name", text).code == 0
    done = plc_gateway("read", running, "mixer/name", "mixer/run", "--json", "--max-age", "0s")
    assert done.code == 0
    name, run = documents(done.out)
    assert (name["tag"], name["value"], name["quality"]) == ("mixer/name", text, "good")
    assert (run["tag"], run["quality"]) == ("mixer/run", "good")


@pytest.mark.parametrize(
    ("tag", "typed", "value", "how"),
    [
        ("mixer/trim", "-3", "-3", "acknowledged and read back"),
        ("mixer/offset", "-12.5", "-12.5", "acknowledged by the PLC"),
        ("mixer/run", "true", "true", "acknowledged by the PLC"),
        ("mixer/level", str(10**20), "1.0000000200408773e+20", "acknowledged by the PLC"),
        ("mixer/name", "[bold]12[/bold]", "[bold]12[/bold]", "acknowledged by the PLC"),
        ("mixer/name", "12", "12", "acknowledged by the PLC"),
        ("mixer/name", '"a b"', "a b", "acknowledged by the PLC"),
    ],
)
def test_write_says_what_the_plc_said(
    running: Path, tag: str, typed: str, value: str, how: str
) -> None:
    done = plc_gateway("write", running, tag, typed)
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(f"{tag} = {value}: {how}, ")
    assert done.out.endswith(" ms\n")
    [row] = documents(plc_gateway("read", running, tag, "--json", "--max-age", "0s").out)
    assert str(row["value"]) == value.replace("true", "True")


def test_write_as_json(running: Path) -> None:
    done = plc_gateway("write", running, "mixer/trim", "-5", "--json")
    [answer] = documents(done.out)
    assert (done.code, answer["value"], answer["verified"]) == (0, -5, True)
    assert set(answer) == {"value", "time", "verified", "acknowledged", "took"}


def test_health_tells_the_status(running: Path) -> None:
    done = plc_gateway("health", running)
    assert done.code == 0
    assert json.loads(done.out)["devices"] == {"mixer": "up"}


def test_watch_goes_on_and_ctrl_c_ends_it(running: Path) -> None:
    with gateway("watch", running, "mixer/speed", "--json") as watch:
        first = json.loads(watch.says("mixer/speed"))["value"]
        _says_another(watch, first)
        assert watch.end(signal.SIGINT) == 0
        assert not watch.has_said("Traceback")


def test_watch_on_a_terminal_is_a_table_that_changes(running: Path) -> None:
    master, slave = os.openpty()
    termios.tcsetwinsize(slave, (40, 120))
    watch = subprocess.Popen(
        [sys.executable, "-m", "gateway", "watch", running, "mixer/speed", "mixer/run"],
        stdin=slave,
        stdout=slave,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(slave)
    try:
        text = ""
        while len(set(re.findall(r"mixer/speed +(\d+) +rpm +good", text))) < 3:
            text += os.read(master, 4096).decode()  # ends when the program does
        watch.send_signal(signal.SIGINT)
        with suppress(OSError):  # EIO: the other side is closed
            while os.read(master, 4096):
                pass
        assert watch.wait(PATIENCE) == 0
        assert re.search(r"mixer/run +(true|false) +good", text)
    finally:
        watch.kill()
        watch.wait()
        os.close(master)


def test_watch_ends_with_its_reader(running: Path) -> None:
    """As in `plc-gateway watch … | head -1`."""
    watch = f"{sys.executable} -m gateway watch {running} mixer/speed --json | head -n 1"
    done = subprocess.run(
        ["sh", "-c", watch], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert [row["tag"] for row in documents(done.stdout)] == ["mixer/speed"]
    assert done.stderr == ""


def test_watch_never_shows_the_values_of_a_gone_gateway_as_good(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}})}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as first:
        first.says("device answers")
        with gateway("watch", path, "--json") as watch:
            watch.says('"quality": "good"')
            first.end(signal.SIGKILL)
            bad = json.loads(watch.says('"reason": "no-gateway"'))
            assert (bad["tag"], bad["value"], bad["quality"]) == ("mixer/speed", None, "bad")
            seen = len(watch.lines)
            with started(path):
                watch.says('"quality": "good"', after=seen)


def test_watch_sees_a_device_change_that_puts_only_blocks(tmp_path: Path) -> None:
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10"}}, blocks="only")}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device answers")
        with gateway("watch", path, "--json") as watch:
            _says_another(watch, json.loads(watch.says('"quality": "good"'))["value"])


@pytest.fixture
def newer(running: Path, tmp_path: Path) -> Path:
    """The file was changed, the gateway not restarted: it does not know `mixer/new`."""
    document = json.loads(running.read_text())
    mixer = document["lines"]["hall"]["devices"]["mixer"]
    mixer["tags"]["new"] = {"address": "D900", "write": True}
    path = tmp_path / "newer.yaml"
    path.write_text(json.dumps(document))
    return path


def test_a_write_the_running_gateway_does_not_know_ends_with_2(newer: Path) -> None:
    done = plc_gateway("write", newer, "mixer/new", "1")
    assert (done.code, done.out) == (2, "")
    assert done.err.startswith("mixer/new: unknown-tag: there is no tag at plant/mixer/new")
    done = plc_gateway("read", newer, "mixer/new")
    assert done.code == 1
    assert "nothing was answered: is the gateway of this file running?" in done.err


@pytest.mark.parametrize("tags", [[], ["mixer"], ["mixer/run", "mixer/new"]])
def test_read_names_what_nobody_answered_and_ends_with_1(newer: Path, tags: list[str]) -> None:
    done = plc_gateway("read", newer, *tags, "--json")
    assert done.code == 1
    assert "mixer/run" in [row["tag"] for row in documents(done.out)]
    assert done.err == (
        "nothing was answered for mixer/new: does the gateway run with this file as it is now?\n"
    )


def test_a_frozen_gateway_is_not_sent_what_it_would_write_when_nobody_waits(
    tmp_path: Path,
) -> None:
    lines = {"hall": vigor_line("simulator", TAGS)}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines)
    with started(path) as program:
        program.says("device answers")
        assert plc_gateway("write", path, "mixer/trim", "1").code == 0
        with connected(load(path), print) as client:
            os.kill(program.pid, signal.SIGSTOP)
            with pytest.raises(GatewayError, match="nothing was sent"):
                client.write("mixer/trim", 2)
        os.kill(program.pid, signal.SIGCONT)
        while (read := plc_gateway("read", path, "mixer/trim", "--json", "--max-age", "0s")).code:
            pass  # it goes on
        assert [row["value"] for row in documents(read.out)] == [1]


def _says_another(watch: Program, value: object) -> None:
    """Another value than this one comes."""
    after = 1
    while json.loads(watch.says("mixer/speed", after=after))["value"] == value:
        after += 1


# -- without a gateway -------------------------------------------------------------------------


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
        assert set(answer) == {"value", "time", "verified", "acknowledged", "took"}
        assert answer["time"].endswith("Z")
    else:
        assert done.out.startswith("mixer/trim = -5: acknowledged and read back, ")


def test_scan_prints_what_to_write_in_the_file(tmp_path: Path) -> None:
    number = free_port()
    with station("tcp", str(number), stations=(2, 5)):
        port = f"tcp://127.0.0.1:{number}"
        done = plc_gateway("scan", "--port", port, "--protocol", "vigor", "--stations", "1-5")
        assert done.code == 0
        assert done.err == "asking 5 stations at the port\n"
        path = tmp_path / "found.yaml"
        path.write_text(done.out)
        checked = plc_gateway("check", path)
        assert checked.out.endswith("found.yaml: good, 0 tags on 1 line\n"), checked
        nobody = plc_gateway("scan", "--port", port, "--protocol", "vigor", "--stations", "7")
        assert (nobody.code, nobody.out) == (1, "")
        assert nobody.err.endswith(f"no station answered at {port}\n")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--protocol", "vigor"], "--port"),
        (
            ["--port", "COM3", "--protocol", "frames"],
            "scan cannot look for frames: use one of vigor",
        ),
        (["--port", "COM3", "--protocol", "vigor", "--baud", "fast"], "'fast' is no number"),
    ],
)
def test_scan_says_what_was_typed_wrong(command: Command, options: list[str], says: str) -> None:
    done = command("scan", *options)
    assert done.code == 2
    assert says in done.err


def test_direct_on_a_port_that_is_not_there_says_why(tmp_path: Path) -> None:
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


def test_direct_leaves_a_disabled_device_alone(tmp_path: Path) -> None:
    line = vigor_line("simulator", TAGS, enabled=False)
    path = write_config(tmp_path / "config.yaml", free_endpoint(), {"hall": line})
    read = plc_gateway("read", path, "--direct", "--json")
    assert read.code == 1
    assert {row["reason"] for row in documents(read.out)} == {"disabled"}
    write = plc_gateway("write", path, "mixer/trim", "1", "--direct")
    assert write.code == 2
    assert "mixer is disabled" in write.err


def test_direct_does_not_wait_for_what_nobody_can_read(tmp_path: Path) -> None:
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
    assert "broadcast, nobody acknowledges it" in write.out


# -- simulate ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("option", "value", "code", "says"),
    [
        ("--tcp", "4001", 2, "--tcp 4001: write it as 127.0.0.1:4001"),
        ("--tcp", "127.0.0.1:99999", 2, "write it as 127.0.0.1:4001"),
        ("--links", "/no/such/folder", 2, "--links /no/such/folder: there is no such folder"),
    ],
)
def test_simulate_refuses_a_bad_place(
    config: Path, option: str, value: str, code: int, says: str
) -> None:
    done = plc_gateway("simulate", config, option, value)
    assert (done.code, done.out) == (code, "")
    assert says in done.err


@pytest.mark.parametrize("by", [signal.SIGTERM, signal.SIGINT])
def test_simulate_says_where_and_ends_in_good_order(
    config: Path, tmp_path: Path, by: signal.Signals
) -> None:
    with gateway("simulate", config, "--links", tmp_path) as simulated:
        simulated.says(f"line hall: stations 1 at {tmp_path / 'hall'}")
        simulated.says("Ctrl-C ends it.")
        assert simulated.end(by) == 0
    assert not (tmp_path / "hall").is_symlink()
