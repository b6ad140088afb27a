"""The command line, `plc-gateway COMMAND`: each command is a module of this folder."""

import atexit
import errno
import gc
import io
import json
import os
import signal
import sys
from collections import UserDict
from contextlib import suppress
from importlib import import_module
from typing import Annotated, Any, NoReturn, cast

import typer
from typer.core import TyperGroup

from gateway import __version__, config
from gateway.cli.examples import epilog
from gateway.cli.terminal import FAILED, USER_MISTAKE, end
from gateway.errors import BadValue, ConfigError, GatewayError
from gateway.parts import registry

# Module and function of each command, in the order of `--help`.
_COMMANDS = {
    "run": "run:run",
    "demo": "config.demo:demo",
    "check": "config.check:check",
    "read": "read:read",
    "write": "write:write",
    "control": "control:control",
    "watch": "watch:watch",
    "scan": "line.scan_command:scan",
    "peek": "line.peek:peek",
    "new": "config.new:new",
    "bench": "bench.command:bench",
    "import": "sheets.import_command:import_",
    "export": "sheets.export:export",
    "simulate": "line.simulate:simulate",
    "status": "status:status",
    "health": "status:health",
    "fleet": "fleet.command:cli",
    "remote": "fleet.remote:remote",
    "ca": "certificates.command:cli",
    "enrol": "certificates.command:enrol",
    "line": "line.shared:line",
    "doctor": "doctor:doctor",
    "alarms": "alarms:alarms",
    "bridge": "bridge:cli",
    "archive": "archive.command:cli",
    "notify": "notify:notify",
    "audit": "audit:audit",
    "trace": "trace:trace",
    "replay": "line.replay:replay",
    "backup": "history.history:backup",
    "schema": "main:schema",
    "version": "main:version",
    "history": "history.history:cli",
}
_COMMANDS = {name: f"gateway.cli.{place}" for name, place in _COMMANDS.items()}
_COMMANDS |= registry.commands()  # those that stand with their parts
GC_EVERY = 20_000  # new objects: collections while modules are imported take 50 ms and find nothing
_MINUS_IS_NO_OPTION = {"write", "control"}  # a value may begin with a minus sign
_FORM: dict[str, Any] = {
    "no_args_is_help": True,
    "add_completion": False,
    "pretty_exceptions_enable": False,
    "rich_markup_mode": None,
}


class _Loaded(UserDict[str, Any]):
    """The commands by name. Each is imported when it is used: all of them take half a second."""

    def __getitem__(self, name: str) -> Any:
        found = super().__getitem__(name)
        if isinstance(found, str):
            found = self.data[name] = _imported(name, found)
        return found


def _imported(name: str, place: str) -> Any:
    """Returns the command, or the group of commands, for a place in `_COMMANDS`."""
    module, _, function = place.partition(":")
    found = getattr(import_module(module), function)
    alone = typer.Typer(**_FORM)
    if isinstance(found, typer.Typer):
        alone.add_typer(found, name=name)
        group = typer.main.get_group(alone).commands[name]
        for below, command in cast("TyperGroup", group).commands.items():
            command.epilog = epilog(f"{name} {below}")
        return group
    settings = {"ignore_unknown_options": True} if name in _MINUS_IS_NO_OPTION else None
    alone.command(name, context_settings=settings, epilog=epilog(name))(found)
    return typer.main.get_command(alone)


class _Commands(TyperGroup):
    """Declares the commands without importing them."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _Loaded(_COMMANDS)


cli = typer.Typer(
    cls=_Commands,
    name="plc-gateway",
    help="PLCs on serial lines <-> Eclipse Zenoh: polls, mirrors, writes back.",
    **{**_FORM, "add_completion": True},
)

_OUTPUT_FAILED = {errno.ENOSPC, errno.EDQUOT, errno.EIO}  # a full disk, a terminal that has gone


def main() -> None:
    """Runs the command of `sys.argv`. Exit codes: 0 success, 1 failure, 2 the user's mistake."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")  # the search takes 25 ms
    gc.set_threshold(GC_EVERY)
    atexit.register(gc.freeze)  # Python would look through all objects once more: 0.1 s
    if sys.argv[1:2] in (["run"], ["demo"]):  # the service takes it, when it has begun
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGHUP])
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a locale may have ASCII only
    try:
        try:
            cli()
        finally:
            sys.stdout.flush()
    except (ConfigError, BadValue) as error:
        end(str(error), USER_MISTAKE)
    except GatewayError as error:
        end(str(error), FAILED)
    except BrokenPipeError:
        _end_without_output()
    except OSError as error:
        if error.errno not in _OUTPUT_FAILED:
            raise
        with suppress(OSError):
            print(f"the output cannot be written: {error.strerror}", file=sys.stderr, flush=True)
        _end_without_output()


def _end_without_output() -> NoReturn:
    """Exits; Python would report once more what it cannot write."""
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(null, stream.fileno())
    sys.exit(FAILED)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"plc-gateway {__version__}")
        raise typer.Exit


@cli.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Declares the options before the command."""


def schema(
    contract: Annotated[
        bool, typer.Option("--contract", help="Of the documents on Zenoh.")
    ] = False,
) -> None:
    """Print the JSON schema of the configuration file."""
    if contract:
        from gateway.contract.documents.catalogue import described

        print(described().decode(), end="")
    else:
        print(json.dumps(config.schema(), indent=2))


def version() -> None:
    """Print the version."""
    print(__version__)
