"""The `replay` command: what a recording tells, and if this version still reads it the same."""

import json
import re
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.capture import Capture
from gateway.cli.terminal import FAILED, printable
from gateway.cli.trace import line_named
from gateway.config import load
from gateway.errors import ConfigError, GatewayError
from gateway.line.exchanges import shown
from gateway.line.replay import Difference, Learned, Replay
from gateway.line.wire_file import LoggedPiece, LoggedValue, entries
from gateway.values import Value

_OF_LINE = re.compile(r"# line (\S+)$")
Entries = Iterator[LoggedPiece | LoggedValue]


def replay(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Files of a recording, or its folder.")
    ],
    config: Annotated[
        Path, typer.Option("--config", metavar="FILE", help="The YAML file of the line.")
    ],
    line: Annotated[
        str | None, typer.Option("--line", help="The line; left out: that of the recording.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only compare with the values in the recording.")
    ] = False,
    pcapng: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the bytes for Wireshark instead.")
    ] = None,
) -> None:
    """Decode a recording: the values of each reply, with its time. Sends nothing."""
    files = _files(logs)
    of = line_named(load(config), line or _recorded_line(files))
    if pcapng is not None:
        with Capture(pcapng, of) as capture:
            for entry in _entries(files, line):
                if isinstance(entry, LoggedPiece):
                    capture.add(entry.at or 0.0, entry.way, entry.data)
        return
    replayed = Replay(of)
    for event in replayed.run(_entries(files, line)):
        if isinstance(event, Difference):
            at, tag, value = event.logged
            now = json.dumps(event.learned, ensure_ascii=False)
            print(
                f"{_clock(at)} {tag}: {json.dumps(value, ensure_ascii=False)} recorded, {now} now"
            )
        elif not check:
            for text in _lines(event):
                print(printable(text))
    checked = replayed.checked
    print(
        f"{checked.equal} values as recorded, {checked.different} others, "
        f"{checked.missing} not learned",
        file=sys.stdout if check else sys.stderr,
    )
    if checked.different:
        sys.exit(FAILED)
    if check and not checked.equal:
        raise GatewayError("nothing was compared: the recording has no values of this line")


def _files(logs: Sequence[Path]) -> list[Path]:
    found: list[Path] = []
    for log in logs:
        found += sorted(log.glob("*.log")) if log.is_dir() else [log]
    if missing := [str(file) for file in found if not file.is_file()]:
        raise ConfigError(f"there is no file {', '.join(missing)}")
    if not found:
        raise ConfigError(f"no file *.log in {', '.join(map(str, logs))}")
    return found


def _recorded_line(files: Sequence[Path]) -> str:
    """Returns the line of the first note `# line hall-1`. Raises `ConfigError` for several."""
    names = set()
    for file in files:
        with file.open(encoding="utf-8", errors="replace") as log:
            if match := _OF_LINE.match(log.readline().rstrip()):
                names.add(match[1])
    if len(names) != 1:
        raise ConfigError(f"name the line with --line: {', '.join(sorted(names)) or 'not noted'}")
    return str(names.pop())


def _entries(files: Sequence[Path], line: str | None) -> Entries:
    for file in files:
        with file.open(encoding="utf-8", errors="replace") as log:
            yield from entries(log, line)


def _lines(event: Learned) -> Iterator[str]:
    """Returns the good values of a reply, and each reason of bad ones."""
    good = [sample for sample in event.samples if sample.value is not None]
    if good:
        yield f"{_clock(event.at)} {good[0].tag.device}: {shown(good)}"
    for sample in event.samples:
        if sample.value is None:
            yield f"{_clock(event.at)} {sample.tag.key}: bad, {sample.reason}: {sample.detail}"


def _json(value: Value | None) -> str:
    return json.dumps(value, ensure_ascii=False)


def _clock(at: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at)) + f"{at % 1:.3f}"[1:]
