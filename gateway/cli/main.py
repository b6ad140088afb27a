"""The command line, `plc-gateway COMMAND`: each command is a module of this folder."""

import errno
import io
import json
import os
import sys
from contextlib import suppress
from typing import Annotated, NoReturn

import typer

from gateway import __version__
from gateway.cli import (
    alarms,
    backup,
    check,
    control,
    export,
    history,
    import_command,
    new,
    peek,
    read,
    replay,
    run,
    scan_command,
    simulate,
    status,
    trace,
    watch,
    write,
)
from gateway.cli.terminal import FAILED, USER_MISTAKE, end
from gateway.config import schema as config_schema
from gateway.errors import BadValue, ConfigError, GatewayError

cli = typer.Typer(
    name="plc-gateway",
    help="PLCs on serial lines <-> Eclipse Zenoh: polls, mirrors, writes back.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_OUTPUT_FAILED = {errno.ENOSPC, errno.EDQUOT, errno.EIO}  # a full disk, a terminal that has gone


def main() -> None:
    """Runs the command of `sys.argv`. Exit codes: 0 success, 1 failure, 2 the user's mistake."""
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


# In the order of `--help`. A value may begin with a minus sign: then it is no option.
cli.command()(run.run)
cli.command()(check.check)
cli.command()(read.read)
cli.command(context_settings={"ignore_unknown_options": True})(write.write)
cli.command(context_settings={"ignore_unknown_options": True})(control.control)
cli.command()(watch.watch)
cli.command()(scan_command.scan)
cli.command()(peek.peek)
cli.command()(new.new)
cli.command("import")(import_command.import_)
cli.command()(export.export)
cli.command()(simulate.simulate)
cli.command()(status.status)
cli.command()(status.health)
cli.command()(alarms.alarms)
cli.command()(trace.trace)
cli.command()(replay.replay)
cli.command()(backup.backup)
cli.add_typer(history.cli, name="history")


@cli.command()
def schema() -> None:
    """Print the JSON schema of the configuration file."""
    print(json.dumps(config_schema(), indent=2))


@cli.command()
def version() -> None:
    """Print the version."""
    print(__version__)
