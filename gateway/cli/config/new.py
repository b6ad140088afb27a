"""The `new` command: a configuration by asking: scan, stations, names, tags, check."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.config.check import check, size
from gateway.cli.line import scan as scanning
from gateway.cli.line.scan import Found
from gateway.cli.line.scan_command import BaudOption, FormatOption, TimeoutOption, scanned
from gateway.cli.sheets.import_command import add_tags
from gateway.cli.sheets.text_file import write_new
from gateway.cli.terminal import err
from gateway.config import load
from gateway.config.messages import one_of
from gateway.config.settings import parsers
from gateway.config.yaml.insert import written
from gateway.errors import ConfigError
from gateway.protocols.capabilities import Scannable
from gateway.protocols.registry import PROTOCOLS
from gateway.transport import SerialSettings

_PORTS = ("serial/by-id/*", "ttyUSB*", "ttyACM*", "ttyAMA*")
LISTEN = "tcp/127.0.0.1:7447"
_TOP = """\
# Written by plc-gateway on {day}. docs/configuration.md has every setting.

gateway:
  name: {name}                      # this gateway's own name in its keys
zenoh:
  prefix: plant                   # the beginning of every key: plant/<device>/<tag>
  listen: [{listen}]    # this machine only; tcp/0.0.0.0:7447: the whole network
defaults:
  every: {every:<24} # how often a tag is read; a tag may have its own
lines:
"""
_LINE = """  {line}:
    port: {port}
"""
_SERIAL = """\
    baudrate: {baudrate}
    format: {format}
"""
_BEHIND = """\
    # baudrate: 19200             # of the wire behind a device server: loads and times need it
"""


def new(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The YAML file to write.")] = Path(
        "plant.yaml"
    ),
    port: Annotated[str | None, typer.Option(help="/dev/ttyUSB0, tcp://host:port ...")] = None,
    protocol: Annotated[
        str | None, typer.Option(help="as the file names it after `protocol:`")
    ] = None,
    stations: Annotated[
        str | None, typer.Option(help="the stations to look for, e.g. 1-31,40")
    ] = None,
    baud: BaudOption = None,
    serial_format: FormatOption = None,
    timeout: TimeoutOption = "200ms",
    use: Annotated[
        str | None, typer.Option(help="the stations to use of those found, e.g. 1,5; or all")
    ] = None,
    names: Annotated[
        str | None, typer.Option(help="their names in the keys, e.g. mixer,oven")
    ] = None,
    line: Annotated[str | None, typer.Option(help="the name of the line (hall-1)")] = None,
    name: Annotated[str | None, typer.Option(help="the name of the gateway (demo)")] = None,
    every: Annotated[str, typer.Option(help="how often tags without an interval are read")] = "1s",
    tags: Annotated[
        list[str] | None,
        typer.Option(metavar="SHEET", help="tags.csv, or mixer=tags.csv; none: no tags yet"),
    ] = None,
) -> None:
    """Make a configuration: scan a line, name its stations, import their tags, check.

    Asks on a terminal for all that no option says. Sends only requests that change nothing.
    """
    if file.exists():
        raise ConfigError(f"{file} exists already: name another file, or use `import`")
    parsers.interval(every)
    port = _asked("port", f"Port{_ports()}", port)
    known = [name for name, one in PROTOCOLS.items() if isinstance(one.settings, Scannable)]
    protocol = _asked("protocol", f"Protocol: {one_of(known)}", protocol)
    plan = scanning.planned(port, protocol, stations, baud, serial_format, timeout)
    gateway_name = parsers.name(_asked("name", "Name of the gateway", name, "demo"))
    line_name = parsers.name(_asked("line", "Name of the line", line, "hall-1"))
    found = scanned(plan, f"no station replied at {port}: nothing was written").found
    numbers = ", ".join(str(one.driver.station) for one in found)
    chosen = _chosen(found, _asked("use", f"Stations found: {numbers}. Use", use, "all"))
    devices = _named(chosen, names)
    sheets = _sheets(tags, [device.name for device in devices])
    behind = baud if baud is not None and baud.isdecimal() else None
    text = document(gateway_name, line_name, port, devices, every, behind)
    write_new(file, text)
    print(f"{file}: written")
    for sheet, wanted in sheets:
        _import(sheet, file, wanted)
    if sheets:
        check(file)
        print(f"next: plc-gateway read {file} --direct, then plc-gateway run {file}")
    else:
        print(f"{file}: good, {size(load(file))}")
        print(f"next: plc-gateway import SHEET --into {file}, or plc-gateway peek {file} ...")


@dataclass(frozen=True, slots=True)
class NamedStation:
    name: str
    found: Found


def document(
    gateway: str,
    line: str,
    port: str,
    devices: Sequence[NamedStation],
    every: str = "1s",
    baud: str | None = None,
) -> str:
    """Returns the text of a configuration, with comments, without tags.

    `baud`: of the wire behind a device server.
    """
    return head_text(gateway, every) + line_text(line, port, devices, baud)


def head_text(gateway: str, every: str = "1s", listen: str = LISTEN) -> str:
    """Returns the text of a configuration before its first line."""
    day = date.today().isoformat()  # noqa: DTZ011  (the date of the person who reads it)
    return _TOP.format(day=day, name=written(gateway), every=every, listen=listen)


def line_text(
    line: str,
    port: str,
    devices: Sequence[NamedStation],
    baud: str | None = None,
    *,
    simulated: bool = False,
) -> str:
    """Returns the text of a line as it stands below `lines:`."""
    text = _LINE.format(line=written(line), port=written(port))
    text += "    origin: simulated\n" if simulated else ""
    serial: SerialSettings | None = devices[0].found.serial
    if serial is not None:
        text += _SERIAL.format(baudrate=serial.baudrate, format=serial.format)
    elif not devices[0].found.driver.traits.over_network:
        text += _BEHIND if baud is None else f"    baudrate: {baud}   # of the wire behind it\n"
    text += "    devices:\n"
    for device in devices:
        driver, refusal = device.found.driver, device.found.refusal
        note = f"   # it sent an error reply: {refusal}" if refusal else ""
        settings = {"protocol": driver.protocol, "station": driver.station}
        text += f"      {written(device.name)}:{note}\n"
        for key, value in {**settings, **device.found.settings}.items():
            text += f"        {key}: {written(value)}\n"
        text += "        tags: {}\n"
    return text


def _asked(option: str, question: str, given: str | None, usual: str | None = None) -> str:
    """Returns the option, the answer of a person, or without a terminal the usual value."""
    if given is not None:
        return given
    if sys.stdin.isatty():
        answer: str = typer.prompt(question, default=usual, err=True)
        return answer.strip()
    if usual is None:
        raise ConfigError(f"--{option} is missing, and there is no terminal to ask at")
    return usual


def serial_ports() -> list[str]:
    return [str(path) for pattern in _PORTS for path in sorted(Path("/dev").glob(pattern))]


def _ports() -> str:
    found = serial_ports()
    return f" ({', '.join(found)})" if found else " (such as /dev/ttyUSB0 or tcp://10.0.0.7:4001)"


def _chosen(found: Sequence[Found], text: str) -> list[Found]:
    if text.strip().casefold() == "all":
        return list(found)
    by_number = {one.driver.station: one for one in found}
    numbers = list(dict.fromkeys(scanning.numbers(text)))
    for number in numbers:
        if number not in by_number:
            known = one_of(map(str, by_number))
            raise ConfigError(f"station {number} did not reply: use {known}")
    return [by_number[number] for number in numbers]


def _named(found: Sequence[Found], names: str | None) -> list[NamedStation]:
    given = [] if names is None else [name.strip() for name in names.split(",")]
    if given and len(given) != len(found):
        raise ConfigError(f"--names has {len(given)} names for {len(found)} stations")
    devices = []
    for number, one in enumerate(found):
        station = one.driver.station
        own = given[number] if given else None
        text = _asked("names", f"Name of station {station}", own, f"station-{station}")
        devices.append(NamedStation(parsers.name(text), one))
    if len({device.name for device in devices}) < len(devices):
        raise ConfigError("two stations have the same name: it is the key of their values")
    return devices


def _sheets(given: list[str] | None, devices: Sequence[str]) -> list[tuple[Path, list[str]]]:
    """Returns the sheets to import, each with its devices; no devices: those that it names."""
    found: list[tuple[Path, list[str]]] = []
    for text in given or []:
        device, equals, file = text.partition("=")
        if equals and device not in devices:
            raise ConfigError(f"--tags {text}: there is no device {device}: use {one_of(devices)}")
        if text != "none":
            found.append((Path(file if equals else text), [device] if equals else []))
    if given is None and sys.stdin.isatty():
        for device in devices:
            found += [(sheet, [device]) for sheet in _asked_sheet(device)]
    for sheet, _ in found:
        if not sheet.is_file():
            raise ConfigError(f"there is no file {sheet}")
    return found


def _asked_sheet(device: str) -> list[Path]:
    """Returns the sheet that a person names for a device, or nothing."""
    while True:
        file = _asked(
            "tags", f"Sheet with the tags of {device} (CSV, .xlsx, .xls, .ods)", None, "none"
        )
        if file == "none":
            return []
        if Path(file).is_file():
            return [Path(file)]
        err.print(f"there is no file {file}")


def _import(sheet: Path, file: Path, devices: list[str]) -> None:
    try:
        for sentence in add_tags(sheet, file, devices, backup=False):
            print(sentence)
    except ConfigError as error:
        device = f" --device {devices[0]}" if devices else ""
        raise ConfigError(
            f"{error}\n{file} is written without these tags. Correct the sheet, then: "
            f"plc-gateway import {sheet} --into {file}{device}"
        ) from None
