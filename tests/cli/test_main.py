"""The commands as a whole: help, usage, version, exit codes. People see no traceback."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from gateway import __version__
from gateway.cli.examples import EXAMPLES
from gateway.cli.main import cli
from gateway.config import schema as config_schema
from gateway.contract.documents.catalogue import FILE
from tests.cli.conftest import documents
from tests.conftest import Command
from tests.contract.reader import Reader
from tests.e2e.processes import Done

ROOT = Path(__file__).parents[2]
EXAMPLE = str(ROOT / "config.example.yaml")
COMMANDS = [
    *("run", "check", "read", "write", "control", "watch", "scan", "simulate"),
    *("status", "health", "doctor", "schema", "version"),
]


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


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_of_the_help_are_commands(name: str) -> None:
    command: Any = typer.main.get_command(cli)
    for part in name.split():
        command = command.commands[part]
    assert f"plc-gateway {name}" in str(command.epilog)
    for text in EXAMPLES[name]:
        with command.make_context(name, shlex.split(text)):
            pass


def test_every_command_has_examples() -> None:
    group: Any = typer.main.get_command(cli)
    found = {
        name
        for name, one in group.commands.items()
        if getattr(one, "invoke_without_command", not hasattr(one, "commands"))
    }
    assert {name for name in EXAMPLES if " " not in name} == found


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ("read FILE mixer/speed", ["mixer/speed"]),
        ("watch FILE --json mixer/sp", ["mixer/speed"]),
        ("control FILE mi", ["mixer"]),
        ("trace FILE hall-1", ["hall-1"]),
        ("alarms FILE --ack line:hall-1", ["line:hall-1"]),
        ("alarms FILE --shelve mixer", ["mixer", "mixer/level"]),
        ("read nothing.yaml mixer/s", []),
    ],
)
def test_the_shell_completes_names_of_the_file(words: str, found: list[str]) -> None:
    line = f"plc-gateway {words}".replace("FILE", EXAMPLE)
    variables = {
        "_PLC_GATEWAY_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(line.split()) - 1),
    }
    program = "import sys; sys.argv = ['plc-gateway']; from gateway.cli.main import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == found


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "Usage"),
        (["fly"], "No such command 'fly'"),
        (["check"], "Missing argument 'CONFIG'"),
        (["read", "a.yaml", "--fast"], "No such option"),
        (["run", "a.yaml", "--log-format", "xml"], "xml"),
        (["write", "a.yaml", "mixer/trim"], "Missing argument 'VALUE'"),
        (["write", EXAMPLE, "mixer/run", "on", "off"], "takes one value; for several tags name"),
        (["write", EXAMPLE, "mixer", "run"], "run is no tag=value, as in mixer recipe/a=1"),
        (["write", EXAMPLE, "mixer", "run=on", "run=off"], "mixer/run is named twice"),
        (["write", EXAMPLE, "mixer", "recipe=41", "run=2", "x=1"], "there is no tag mixer/x"),
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
        ("status", []),
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


def test_a_folder_instead_of_a_file_ends_with_2(command: Command, tmp_path: Path) -> None:
    done = command("check", tmp_path)
    assert done.code == 2
    assert len(done.err.splitlines()) == 1


def test_schema_prints_the_schema(command: Command) -> None:
    done = command("schema")
    assert (done.code, done.json) == (0, config_schema())


def test_the_version_is_an_option_and_a_command(command: Command) -> None:
    assert command("--version") == Done(0, f"plc-gateway {__version__}\n", "")
    assert command("version") == Done(0, f"{__version__}\n", "")


@pytest.mark.parametrize(
    "arguments", [["read"], ["write", "mixer/trim", "1"], ["status"], ["health"]]
)
def test_without_a_gateway_commands_end_with_1(
    command: Command, config: Path, arguments: list[str]
) -> None:
    name, *more = arguments
    done = command(name, config, *more)
    assert (done.code, done.out) == (1, "")
    assert "no gateway at tcp/127.0.0.1:" in done.err
    assert "start it with `plc-gateway run`, or use --direct" in done.err
    assert len(done.err.splitlines()) == 1


def test_the_documents_of_commands_have_the_schemas_of_the_contract(
    command: Command, running: Path
) -> None:
    reader = Reader(json.loads(FILE.read_text("utf-8")), "plant")

    def fit(name: str, *found: dict[str, Any]) -> None:
        assert found
        assert [reader.violations(name, one) for one in found] == [[]] * len(found)

    def said(*arguments: object) -> list[dict[str, Any]]:
        return documents(command(*arguments, "--json").out)

    def without_tag(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{name: one for name, one in row.items() if name != "tag"} for row in rows]

    fit("value", *without_tag(said("read", running)))
    fit("meta", *without_tag(said("export", running)))
    fit("write", *said("write", running, "mixer/trim", "3"))
    fit("group", *said("write", running, "mixer", "trim=3", "offset=1"))
    fit("status", *said("health", running))
    fit("alarm", *command("alarms", running, "--all", "--json").json)
    [status] = said("status", running)
    for path, document in status.items():
        fit(path.partition("/")[0], document)


def test_status_and_health_import_no_protocol(running: Path) -> None:
    """A probe runs each few seconds, so it shall cost little: see benchmarks/commands.py."""
    program = (
        "import sys, atexit; from gateway.cli.main import main; "
        f"sys.argv = ['plc-gateway', 'health', '--strict', {str(running)!r}]; "
        "atexit.register(lambda: print([name for name in ('gateway.config.build', "
        "'gateway.tags.tag', 'gateway.protocols.registry', 'asyncio', 'structlog', 'serialx', "
        "'pymodbus', 'lark') if name in sys.modules])); main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_mistake_elsewhere_in_the_file_does_not_hide_the_running_gateway(
    command: Command, running: Path, tmp_path: Path
) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(running.read_text().replace('"D500"', '"D50O"'))
    assert command("check", path).code == 2
    assert command("health", path).code == 0


def test_health_prints_the_status(command: Command, running: Path) -> None:
    assert command("health", running).out.endswith(": it answers\n")
    done = command("health", "--json", running)
    assert done.code == 0
    assert done.json["devices"] == {"mixer": "up"}
