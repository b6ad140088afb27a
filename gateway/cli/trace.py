"""The `trace` command: the exchanges of a line as they pass, from the running gateway."""

import json
import os
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Any, Self

import typer

from gateway import files
from gateway.cli import completion
from gateway.cli.client import connected
from gateway.cli.line.capture import Capture
from gateway.cli.progress import loaded
from gateway.cli.terminal import AsJson, ConfigPath, err, printable
from gateway.config import Config, LineConfig
from gateway.config.messages import meant
from gateway.config.settings import parsers
from gateway.errors import ConfigError, GatewayError, words_of
from gateway.parts.recording.wire_file import event_lines

LineName = Annotated[
    str, typer.Argument(metavar="LINE", help="A line of the file.", autocompletion=completion.lines)
]
_WIDTH = 40  # characters of the request


def trace(
    config: ConfigPath,
    line: LineName,
    show_bytes: Annotated[
        bool, typer.Option("--bytes", help="Show the bytes below each exchange.")
    ] = False,
    record: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Record into files of this folder.")
    ] = None,
    keep: Annotated[
        str, typer.Option(metavar="SIZE", help="The most that the recording may take.")
    ] = "100MB",
    pcapng: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the bytes for Wireshark.")
    ] = None,
    for_: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="End after this time: 30s, 2min.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print each exchange of a line, decoded, as it passes. Ctrl-C ends it."""
    plant = loaded(config)
    found = line_named(plant, line)
    if found.serve:
        raise ConfigError(
            f"{line} is a served line: only the lines that the gateway asks are traced"
        )
    size = parsers.size(keep)
    until = None if for_ is None else time.monotonic() + parsers.duration(for_)
    with ExitStack() as stack:
        client = stack.enter_context(connected(plant, err.print))
        recording = None
        if record is not None:
            recording = stack.enter_context(Recording(record, line, size, notes(found)))
            err.print(f"recording {line} into {recording.path}; Ctrl-C ends it")
        capture = None if pcapng is None else stack.enter_context(Capture(pcapng, found))
        stack.enter_context(suppress(KeyboardInterrupt))
        for event in _events(client.trace(line, until)):
            if recording is not None:
                recording.add(event_lines(event))
            if capture is not None and "way" in event:
                capture.add(event["time"], event["way"], bytes.fromhex(event["bytes"]))
            if as_json:
                print(json.dumps(event), flush=True)
            elif record is None and ("way" not in event or show_bytes):
                print(printable(shown(event)), flush=True)


def line_named(config: Config, name: str) -> LineConfig:
    """Raises `ConfigError` for a line that is not in the file."""
    lines = {line.name: line for line in config.lines}
    if name not in lines:
        raise ConfigError(f"there is no line {name}: {meant(name, lines)}")
    return lines[name]


def notes(line: LineConfig) -> list[str]:
    """Returns the protocols of the line and its speed, for a replay without the file."""
    drivers = [device.driver for device in line.devices]
    found = [f"protocol {one}" for one in dict.fromkeys(driver.protocol for driver in drivers)]
    if not any(driver.traits.over_network for driver in drivers):
        found.append(f"wire {line.serial.baudrate} {line.serial.format}")
    return found


def shown(event: dict[str, Any]) -> str:
    """Returns one event as a line for people, with the local time."""
    at = clock(event["time"])
    if "way" in event:
        return f"{at}   {event['way']} {event['bytes']}"
    text = f"{event['device']}: {event['what']}"
    failed = "! " if event["failed"] else ""
    result = f"  {failed}{event['result']}" if event["result"] else ""
    return f"{at} {event['took'] * 1000:8.1f} ms  {text:{_WIDTH}}{result}".rstrip()


def clock(at: float) -> str:
    """Returns the local time: `13:00:00.123`. `at`: seconds since 1970."""
    return time.strftime("%H:%M:%S", time.localtime(at)) + f"{at % 1:.3f}"[1:]


def _events(documents: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yields the events of the documents. Says how many were lost on the way."""
    number = None
    for document in documents:
        lost = document["missed"]
        if number is not None and document["number"] > number + 1:
            err.print(f"{document['number'] - number - 1} parts of the trace were lost on the way")
        if lost:
            err.print(f"{lost} events were left out: the line is too fast")
        number = document["number"]
        yield from document["events"]


FILES = 10  # of one recording: a tenth of it is deleted at once


class Recording:
    """The files of one line in a folder, named after it and the time: `hall-1-20261120T1200….log`.

    Raises `GatewayError` when the disk is full or fails. The last file ends with a whole line.
    """

    def __init__(self, folder: Path, line: str, keep: int, notes: Iterable[str] = ()) -> None:
        """`keep`: bytes of all files together. `notes`: at the begin of each file."""
        self._folder = folder
        self._line = line
        self._note = f"# line {line}\n" + "".join(f"# {note}\n" for note in notes)
        self._most = max(1, keep // FILES)
        self._file: int | None = None
        self._path = folder
        self._size = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._next()
        except OSError as error:
            raise self._failed(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    @property
    def path(self) -> Path:
        """The file that is written now."""
        return self._path

    def add(self, text: str) -> None:
        """Adds whole lines. A file of any size gets them all."""
        data = text.encode()
        try:
            if self._size and self._size + len(data) > self._most:
                self._next()
            self._write(data)
        except OSError as error:
            raise self._failed(error) from error

    def _write(self, data: bytes) -> None:
        if self._file is None:
            raise AssertionError("no file is open")
        files.append(self._file, data)
        self._size += len(data)

    def _next(self) -> None:
        self._close()
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        while self._file is None:
            now = time.time_ns() // 1000
            stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(now // 10**6))
            self._path = self._folder / f"{self._line}-{stamp}.{now % 10**6:06}.log"
            with suppress(FileExistsError):
                self._file = os.open(self._path, flags, 0o640)
        self._size = 0
        self._write(self._note.encode())
        for old in self._files()[:-FILES]:
            old.unlink(missing_ok=True)

    def _files(self) -> list[Path]:
        """Returns the files of this line, the oldest first."""
        named = re.compile(re.escape(self._line) + r"-\d{8}T\d{6}\.\d{6}\.log")
        found = (path for path in self._folder.iterdir() if named.fullmatch(path.name))
        return sorted(found)

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _failed(self, error: OSError) -> GatewayError:
        why = words_of(error)
        return GatewayError(f"recording ended: {self._path}: {why}; the gateway goes on")
