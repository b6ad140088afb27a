"""The command line: run, check, read, write, watch, simulate, schema."""

import asyncio
import json
import logging
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NoReturn

import structlog
import typer
import zenoh
from rich.console import Console
from rich.live import Live

from gateway import __version__, app, direct, show, simulate
from gateway.client import Client, Shown, connected, parse_value
from gateway.config import Config, load
from gateway.config import schema as config_schema
from gateway.errors import BadValue, ConfigError, GatewayError
from gateway.forecast import LineForecast, forecast
from gateway.tags import Tag

USER_MISTAKE, FAILED = 2, 1
out = Console(highlight=False, width=None if sys.stdout.isatty() else 200)
err = Console(stderr=True, highlight=False, soft_wrap=True)
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


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


class LogLevel(StrEnum):
    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


def main() -> None:
    """The console command. Exit codes: 0 good, 1 it failed, 2 the user's mistake."""
    try:
        cli()
    except ConfigError as error:
        _end(str(error), USER_MISTAKE)
    except BadValue as error:
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
    _log(log_format, log_level)
    asyncio.run(app.run(loaded, lambda: err.print(show.next_steps(loaded, str(config)))))


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
    lines = _forecasts(loaded)
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
    out.print(f"{config}: good, {len(_tags(loaded))} tags on {len(lines)} lines")


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
    wanted = _wanted(loaded, tags)
    if without_gateway:
        _log(LogFormat.TEXT, LogLevel.ERROR)
        chosen = [tag for tag in _tags(loaded).values() if _matches(tag.key, wanted)]
        found = [show.shown(s) for s in asyncio.run(direct.read(loaded, chosen))]
    else:
        with connected(loaded) as client:
            found = [row for want in wanted for row in client.values(want, max_age)]
            if not found:
                raise GatewayError("nothing was answered: is the gateway of this file running?")
    _print(found, _tags(loaded), as_json=as_json)
    if not all(show.is_good(row) for row in found):
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
    text = parse_value(value)
    if known.layout.type.kind == "string":
        text = value
    if without_gateway:
        _log(LogFormat.TEXT, LogLevel.ERROR)
        answer: dict[str, object] = asyncio.run(direct.write(loaded, known, text))._asdict()
    else:
        known.encode(text)
        with connected(loaded) as client:
            answer = client.write(tag, text)
    if as_json:
        out.print(json.dumps(answer))
    elif "error" in answer:
        err.print(f"{tag}: {answer['error']}: {answer.get('reason')}", style="red")
    else:
        out.print(f"{tag} = {answer['value']}: {_how(answer)}")
    if "error" in answer:
        sys.exit(USER_MISTAKE if answer["error"] == "bad-value" else FAILED)


@cli.command()
def watch(config: ConfigPath, tags: TagNames = None, as_json: AsJson = False) -> None:
    """A live table of values; Ctrl-C ends it."""
    loaded = load(config)
    wanted, known = _wanted(loaded, tags), _tags(loaded)
    with connected(loaded) as client, suppress(KeyboardInterrupt):
        if as_json or not out.is_terminal:
            _follow(client, wanted, lambda row: _print([row], known, as_json=as_json))
        else:
            _live_table(client, wanted, known)


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
    _log(LogFormat.TEXT, LogLevel.INFO)
    asyncio.run(simulate.serve(loaded, tcp, links, out.print))


@cli.command()
def health(config: ConfigPath) -> None:
    """Ask the running gateway how it is: exit code 0 when it answers (for containers)."""
    with connected(load(config)) as client:
        out.print(json.dumps(client.status()))


@cli.command()
def schema() -> None:
    """Print the JSON schema of the configuration file."""
    print(json.dumps(config_schema(), indent=2))


@cli.command()
def version() -> None:
    """Print the version."""
    out.print(__version__)


def _end(message: str, code: int) -> NoReturn:
    err.print(message, markup=False)
    sys.exit(code)


def _log(form: LogFormat, level: LogLevel) -> None:
    logging.basicConfig(
        format="%(message)s", stream=sys.stderr, level=getattr(logging, level.upper())
    )
    render = (
        structlog.processors.JSONRenderer()
        if form is LogFormat.JSON
        else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            structlog.stdlib.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            render,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )


def _tags(config: Config) -> dict[str, Tag]:
    return {tag.key: tag for device in config.devices for tag in device.tags}


def _wanted(config: Config, names: list[str] | None) -> list[str]:
    """The key expressions to ask for; a name without wildcard must be a tag or a device."""
    if not names:
        return ["**"]
    known, devices = _tags(config), {device.name for device in config.devices}
    wanted = []
    for name in names:
        if name in devices:
            name = f"{name}/**"
        elif "*" not in name and name not in known:
            raise ConfigError(f"there is no tag or device {name}")
        wanted.append(name)
    return wanted


def _matches(key: str, wanted: list[str]) -> bool:
    return any(zenoh.KeyExpr(want).intersects(zenoh.KeyExpr(key)) for want in wanted)


def _print(rows: list[Shown], tags: dict[str, Tag], *, as_json: bool) -> None:
    if as_json:
        for row in rows:
            out.print(json.dumps({"tag": row.tag, **row.document}), markup=False)
    else:
        out.print(show.samples(rows, tags))


def _how(answer: dict[str, object]) -> str:
    took = f"{float(str(answer['took'])) * 1000:.0f} ms"
    if answer.get("verified"):
        return f"acknowledged and read back, {took}"
    if answer.get("acknowledged") is False:
        return f"broadcast, nobody acknowledges it, {took}"
    return f"acknowledged by the PLC, {took}"


def _forecasts(config: Config) -> list[LineForecast]:
    return [
        forecast(
            line.name,
            [app.device_of(device, line) for device in line.devices if device.enabled],
            line.wire,
        )
        for line in config.lines
    ]


def _follow(client: Client, wanted: list[str], told: Callable[[Shown], None]) -> None:
    with ExitStack() as stack:
        for want in wanted:
            stack.enter_context(client.watching(want, told))
            for row in client.values(want):
                told(row)
        threading.Event().wait()


def _live_table(client: Client, wanted: list[str], tags: dict[str, Tag]) -> None:
    rows: dict[str, Shown] = {}
    with Live(console=out, refresh_per_second=5, screen=False) as live:

        def told(row: Shown) -> None:
            rows[row.tag] = row

        threading.Thread(target=_follow, args=(client, wanted, told), daemon=True).start()
        while True:
            live.update(show.samples(sorted(dict(rows).values()), tags))
            time.sleep(0.2)
