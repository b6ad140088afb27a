"""The command line: run, check, read, write, watch, scan, simulate, schema."""

import asyncio
import json
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console

from gateway import __version__, app, northbound, service
from gateway.cli import direct, scan, simulate
from gateway.cli import tables as show
from gateway.cli.client import Shown, connected, matches, parse_value, wanted_keys
from gateway.cli.logs import LogFormat, LogLevel, set_up
from gateway.config import Config, load
from gateway.config import schema as config_schema
from gateway.config.commands import check_command, line_of
from gateway.errors import BadValue, ConfigError, GatewayError
from gateway.northbound.keys import max_age as age_of
from gateway.northbound.payload import Problem
from gateway.tags import Tag
from gateway.transport.loop import new_event_loop
from gateway.values import Kind

USER_MISTAKE, FAILED = 2, 1
_MISTAKES = {Problem.BAD_VALUE, Problem.NOT_WRITABLE, Problem.UNKNOWN_TAG}
# What is printed is text, whatever brackets and colons a tag has in its value.
out = Console(
    highlight=False, markup=False, emoji=False, width=None if sys.stdout.isatty() else 200
)
err = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
cli = typer.Typer(
    name="plc-gateway",
    help="PLCs on serial lines <-> Eclipse Zenoh: polls, mirrors, writes back.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigPath = Annotated[Path, typer.Argument(metavar="CONFIG", help="The YAML file.")]
TagNames = Annotated[
    list[str] | None,
    typer.Argument(metavar="[TAG]...", help="device/tag; wildcards as in Zenoh: 'mixer/**'"),
]
Direct = Annotated[
    bool, typer.Option("--direct", help="Open the port here; no gateway may be running on it.")
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON document per line.")]


def main() -> None:
    """The console command. Exit codes: 0 good, 1 it failed, 2 the user's mistake."""
    try:
        cli()
    except (ConfigError, BadValue) as error:
        _end(str(error), USER_MISTAKE)
    except GatewayError as error:
        _end(str(error), FAILED)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(FAILED)


@cli.command()
def run(
    config: ConfigPath,
    log_format: Annotated[LogFormat, typer.Option(help="text for people, json for machines")] = (
        LogFormat.TEXT
    ),
    log_level: Annotated[LogLevel, typer.Option(help="debug shows every byte")] = LogLevel.INFO,
) -> None:
    """The service: poll, mirror onto Zenoh, take writes. SIGTERM or Ctrl-C ends it."""
    loaded = load(config)
    set_up(log_format, log_level)
    hint = show.next_steps(loaded, config, show.typed())
    with asyncio.Runner(loop_factory=new_event_loop) as runner:
        runner.run(service.run(loaded, lambda: err.print(hint)))


@cli.command()
def check(
    config: ConfigPath,
    blocks: Annotated[
        bool | None,
        typer.Option("--blocks/--no-blocks", help="Every request (default: up to 100 of them)"),
    ] = None,
) -> None:
    """Validate the file and print what it will do to each line. Sends nothing."""
    loaded = load(config)
    northbound.check(loaded)
    lines = app.forecasts(loaded)
    few = sum(len(line.blocks) for line in lines) <= 100
    out.print(show.plan(lines, every_block=few if blocks is None else blocks))
    for tag in _tags(loaded).values():
        if tag.write is not None and tag.address.bit is not None:
            err.print(
                f"note: writing {tag.key} ({tag.text}) reads the word, changes one bit and writes "
                "the word back; what the PLC changes in it meanwhile is lost"
            )
    for line in lines:
        if line.overloaded:
            err.print(f"warning: {line.advice()}")
    print(f"{config}: good, {show.size(loaded)}")


@cli.command()
def read(
    config: ConfigPath,
    tags: TagNames = None,
    without_gateway: Direct = False,
    max_age: Annotated[
        str | None, typer.Option(help="Read the PLC unless the sample is younger, e.g. 0s")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """The current values, through the running gateway or --direct from the PLC."""
    loaded = load(config)
    wanted = wanted_keys(loaded, tags)
    complete = True
    if max_age is not None:
        age_of(max_age)  # wrong: said at once, without a gateway
    if without_gateway:
        set_up(LogFormat.TEXT, LogLevel.ERROR)
        chosen = [tag for tag in _tags(loaded).values() if matches(tag.key, wanted)]
        samples = asyncio.run(direct.read(loaded, chosen))
        found = [show.shown(sample) for sample in samples]
        for trouble in dict.fromkeys(f"{s.tag.device}: {s.detail}" for s in samples if s.detail):
            err.print(trouble)
    else:
        with connected(loaded, err.print) as client:
            found = [row for want in wanted for row in client.values(want, max_age)]
            if not found:
                raise GatewayError(client.nothing)
            complete = client.complete(wanted, found)
    _print(found, _tags(loaded), as_json=as_json)
    if not (complete and all(show.is_good(row) for row in found)):
        sys.exit(FAILED)


@cli.command(context_settings={"ignore_unknown_options": True})
def write(
    config: ConfigPath,
    tag: Annotated[str, typer.Argument(metavar="TAG", help="device/tag")],
    value: Annotated[str, typer.Argument(metavar="VALUE", help="JSON: true, 12.5, AB")],
    without_gateway: Direct = False,
    as_json: AsJson = False,
) -> None:
    """Write one tag and print what the PLC said."""
    loaded = load(config)
    known = _tags(loaded).get(tag)
    if known is None:
        raise ConfigError(f"there is no tag {tag} in {config}")
    if known.write is None:
        raise ConfigError(f"{tag} cannot be written: it has no `write: true` in {config}")
    wanted = parse_value(value)
    if known.layout.type.kind is Kind.STRING and not isinstance(wanted, str):
        wanted = value  # 12 is a text here
    try:
        known.encode(wanted)
    except BadValue as error:
        raise BadValue(f"{tag}: {error}") from None
    if without_gateway:
        set_up(LogFormat.TEXT, LogLevel.ERROR)
        answer = direct.told(loaded, known, wanted)
    else:
        with connected(loaded, err.print) as client:
            answer = client.write(tag, wanted)
    if as_json:
        print(json.dumps(answer))
    elif "error" in answer:
        err.print(show.outcome(tag, answer), style="red")
    else:
        print(show.outcome(tag, answer))
    if "error" in answer:
        sys.exit(USER_MISTAKE if answer["error"] in _MISTAKES else FAILED)


@cli.command(name="control", context_settings={"ignore_unknown_options": True})
def control_command(
    config: ConfigPath,
    device: Annotated[str, typer.Argument(metavar="DEVICE")],
    command: Annotated[str, typer.Argument(metavar="COMMAND", help="run, stop, model ...")],
    argument: Annotated[str, typer.Argument(metavar="[ARGUMENT]", help="text; on, off")] = "",
    without_gateway: Direct = False,
) -> None:
    """Have a PLC run, stop ...: what the file allows by `control: true`."""
    loaded = load(config)
    check_command(loaded, device, command)
    if without_gateway:
        set_up(LogFormat.TEXT, LogLevel.ERROR)
        print(asyncio.run(direct.control(loaded, device, command, argument)).answer)
        return
    with connected(loaded, err.print) as client:
        answer = client.control(line_of(loaded, device).name, device, command, argument)
    if "error" in answer:
        _end(show.outcome(device, answer), USER_MISTAKE if answer["error"] in _MISTAKES else FAILED)
    print(answer["answer"])


@cli.command()
def watch(config: ConfigPath, tags: TagNames = None, as_json: AsJson = False) -> None:
    """A live table of values; Ctrl-C ends it."""
    loaded = load(config)
    wanted, known = wanted_keys(loaded, tags), _tags(loaded)
    live = out.is_terminal and not as_json
    tell = out.print if live else err.print  # above the table
    with connected(loaded, tell) as client, suppress(KeyboardInterrupt):
        if live:
            show.live(out, client.follow(wanted), known)
        else:
            for row in client.follow(wanted):
                _print([row], known, as_json=as_json)


@cli.command(name="scan")
def scan_command(
    port: Annotated[str, typer.Option(help="/dev/ttyUSB0, COM3, tcp://host:port, rfc2217://...")],
    protocol: Annotated[str, typer.Option(help="as the file names it after `protocol:`")],
    stations: Annotated[
        str | None, typer.Option(help="which to ask: 1-31,40; left out: those up to 31")
    ] = None,
    baud: Annotated[str | None, typer.Option(help="9600,19200; left out: the likely ones")] = None,
    serial_format: Annotated[
        str | None, typer.Option("--format", help="7E1,8N1; left out: the likely ones")
    ] = None,
    timeout: Annotated[str, typer.Option(help="how long a station may take")] = "200ms",
) -> None:
    """Find out which stations answer at a port, and at which speed and in which format.

    Asks for what changes nothing. No gateway may be running at that port.
    """
    plan = scan.planned(port, protocol, stations, baud, serial_format, timeout)
    set_up(LogFormat.TEXT, LogLevel.ERROR)
    report = asyncio.run(scan.scan(plan, err.print))
    for line in show.noises(report):
        err.print(line)
    if not report.found:
        _end(f"no station answered at {port}", FAILED)
    print(show.stations(report, port))


@cli.command(name="simulate")
def simulate_command(
    config: ConfigPath,
    tcp: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve on TCP: first line here, next port up"),
    ] = None,
    links: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Make a link per line to its pty in DIR")
    ] = None,
) -> None:
    """Serve the configured devices as simulated PLCs on ptys or TCP ports."""
    loaded = load(config)
    set_up(LogFormat.TEXT, LogLevel.INFO)
    asyncio.run(simulate.serve(loaded, tcp, links, partial(print, flush=True)))


@cli.command()
def health(config: ConfigPath) -> None:
    """Ask the running gateway how it is: exit code 0 when it answers (for containers)."""
    with connected(load(config), err.print) as client:
        print(json.dumps(client.status()))


@cli.command()
def schema() -> None:
    """Print the JSON schema of the configuration file."""
    print(json.dumps(config_schema(), indent=2))


@cli.command()
def version() -> None:
    """Print the version."""
    print(__version__)


def _end(message: str, code: int) -> NoReturn:
    err.print(message)
    sys.exit(code)


def _tags(config: Config) -> dict[str, Tag]:
    return {tag.key: tag for device in config.devices for tag in device.tags}


def _print(rows: list[Shown], tags: dict[str, Tag], *, as_json: bool) -> None:
    if as_json:
        for row in rows:
            print(json.dumps({"tag": row.tag, **row.document}), flush=True)
    else:
        out.print(show.samples(rows, tags))
