"""The `run` command: the service."""

import asyncio
import logging
import os
import shlex
import shutil
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

import structlog
import typer

from gateway import __version__
from gateway.cli.config.check import size
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.progress import progress
from gateway.cli.terminal import FAILED, USER_MISTAKE, ConfigPath, err
from gateway.config import Config, load
from gateway.config.share import parse_share
from gateway.ending import LastResort
from gateway.errors import ConfigError, GatewayError
from gateway.parts.web.settings import WebSection
from gateway.service import service
from gateway.tags import Tag, WriteRule
from gateway.transport.loop import new_event_loop
from gateway.values import Kind

log = structlog.get_logger("gateway")
STARTED = "Ctrl-C ends it."  # the last line of what a started gateway says to people


def run(
    config: ConfigPath,
    log_format: Annotated[LogFormat, typer.Option(help="text for people, json for programs")] = (
        LogFormat.TEXT
    ),
    log_level: Annotated[LogLevel, typer.Option(help="debug leaves nothing out")] = LogLevel.INFO,
    share: Annotated[
        str, typer.Option(metavar="N/OF", help="only a share of the lines, for example 2/3")
    ] = "1/1",
) -> None:
    """Run the service: poll, publish on Zenoh, accept writes. SIGTERM or Ctrl-C ends it."""
    read = partial(_loaded, share=share)
    if log_format is LogFormat.TEXT:
        with progress(err) as report:
            loaded = read(config, report)
        serve(loaded, config, set_up(log_format, log_level), read)
    else:
        set_up(log_format, log_level)  # first: a mistake in the file is a document too
        try:
            serve(read(config), config, lambda _text: None, read)
        except GatewayError as error:
            for sentence in str(error).splitlines():
                log.error("gateway failed", why=sentence)  # noqa: TRY400  (a sentence, no trace)
            sys.exit(USER_MISTAKE if isinstance(error, ConfigError) else FAILED)
    end_beside_zenoh()


def _loaded(
    path: Path, report: Callable[[str, float], None] | None = None, *, share: str
) -> Config:
    """Loads the file, or a share of it, which has a folder of its own."""
    numbers = parse_share(share)
    if numbers == (1, 1):
        return load(path, report)
    config = load(path, report, share=numbers)
    if config.folder is not None:
        try:
            config.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{config.folder}: {error.strerror}") from None
    return config


def serve(
    config: Config, path: Path, say: Callable[[str], None], read: Callable[[Path], Config] = load
) -> None:
    """Runs the gateway of a file until it is stopped. `say` gets what to try, when it is ready.

    `read` loads the file again.
    """
    tags = sum(len(device.tags) for device in config.devices)
    log.info(
        "gateway starting",
        version=__version__,
        file=str(path),
        name=config.name,
        lines=len(config.lines),
        tags=tags,
    )
    hint = next_steps(config, path, program())
    runner = asyncio.Runner(loop_factory=new_event_loop)
    last = LastResort(runner.get_loop())
    try:
        runner.run(service.run(config, path, lambda: say(hint), read))
    finally:
        last.start()
        runner.close()  # waits for the threads of the loop: a serial port or a disk may hang
        last.cancel()
    log.info("gateway stopped")


def end_beside_zenoh() -> None:
    """Ends the process without Python's own end, if a thread still waits in Zenoh for a client.

    Python would end that thread inside Zenoh's code, which aborts the process.
    """
    if any(thread.name.startswith("zenoh") for thread in threading.enumerate()):
        logging.shutdown()
        sys.stdout.flush()
        os._exit(0)


def program() -> str:
    """Returns the command that started this program, in a form that can be typed again."""
    path = Path(sys.argv[0])
    if path.name == "__main__.py":
        return f"{sys.executable} -m {path.parent.name}"
    return path.name if shutil.which(path.name) else str(path)


def next_steps(config: Config, path: Path, command: str) -> str:
    """Returns the address of the page, and the commands to try in a second terminal; `command`
    starts this program."""
    file = shlex.quote(str(path))
    tags = [tag for device in config.devices for tag in device.tags]
    web = config.part(WebSection)
    lines = [
        *([] if web is None else [f"Page: {web.url}"]),
        f"Gateway {config.name}: {size(config)}. In a second terminal:",
        f"  {command} watch {file}",
    ]
    if tags:
        lines.append(f"  {command} read {file} {tags[0].key}")
    not_real = (tag for line in config.lines if line.not_real for tag in line.tags)
    for tag in not_real:  # a proposed write must move no machine
        if tag.write is not None and tag.element is None:
            lines.append(f"  {command} write {file} {tag.key} {_example(tag)}")
            break
    lines.append(STARTED)
    return "\n".join(lines)


def _example(tag: Tag) -> str:
    """Returns a value that the tag accepts."""
    kind, rule = tag.layout.type, tag.write or WriteRule()
    if kind.kind is Kind.STRING:
        return "AB"[: kind.length]
    if kind.is_text:
        return "2620-4976"
    if not kind.is_number:
        return "true"
    value = 1 if rule.min is None else rule.min + 1
    return f"{value if rule.max is None else min(value, rule.max):g}"
