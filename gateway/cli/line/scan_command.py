"""The `scan` command: prints the stations that reply at a port, as the file writes them."""

import asyncio
import json
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from gateway.cli.line import scan as scanning
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.line.scan import Found, Report, spoken
from gateway.cli.progress import progress
from gateway.cli.tables import value_text
from gateway.cli.terminal import FAILED, AsJson, end, err

BaudOption = Annotated[str | None, typer.Option(help="9600,19200 (default: the usual ones)")]
FormatOption = Annotated[
    str | None, typer.Option("--format", help="7E1,8N1 (default: the usual ones)")
]
TimeoutOption = Annotated[str, typer.Option(help="the longest turnaround of a station")]


def scan(
    port: Annotated[str, typer.Option(help="/dev/ttyUSB0, tcp://host:port, rfc2217://...")],
    protocol: Annotated[str, typer.Option(help="as the file names it after `protocol:`")],
    stations: Annotated[
        str | None, typer.Option(help="the stations, e.g. 1-31,40 (default: up to 31)")
    ] = None,
    baud: BaudOption = None,
    serial_format: FormatOption = None,
    timeout: TimeoutOption = "200ms",
    as_json: AsJson = False,
) -> None:
    """Find the stations at a port, their speed and their format.

    Sends only requests that change nothing. No gateway may be running at that port.
    """
    plan = scanning.planned(port, protocol, stations, baud, serial_format, timeout)
    report = Report()
    try:
        scanned(plan, f"no station replied at {port}", report)
    finally:  # also what replied before the port was lost, or Ctrl-C
        _print(report, port, as_json=as_json)


def _print(report: Report, port: str, *, as_json: bool) -> None:
    if report.found and not as_json:
        print(found_stations(report, port))
        return
    for found in report.found:
        line = dict[str, object]()
        if (serial := found.serial) is not None:
            line = {"baudrate": serial.baudrate, "format": str(serial.format)}
        print(json.dumps({"port": port, **line, **_device(found), "refusal": found.refusal}))


def scanned(plan: scanning.Plan, none_replied: str, report: Report | None = None) -> Report:
    """Scans; ends the command with the sentence `none_replied` if no station replied."""
    set_up(LogFormat.TEXT, LogLevel.ERROR)
    with progress(err) as share:
        report = asyncio.run(scanning.scan(plan, err.print, share, report))
    for sentence in noises(report):
        err.print(sentence)
    if not report.found:
        end(none_replied, FAILED)
    return report


def found_stations(report: Report, port: str) -> str:
    """Returns the stations found, as the file writes them."""
    serial = report.found[0].serial
    lines = ["lines:", "  found:", f"    port: {port}"]
    if serial is not None:
        lines += [f"    baudrate: {serial.baudrate}", f"    format: {serial.format}"]
    lines.append("    devices:")
    for found in report.found:
        texts = (f"{name}: {value_text(value)}" for name, value in _device(found).items())
        refusal = f"  # error reply: {found.refusal}" if found.refusal else ""
        name = f"station-{found.driver.station}"
        lines.append(f"      {name}: {{{', '.join(texts)}, tags: {{}}}}{refusal}")
    return "\n".join(lines)


def _device(found: Found) -> dict[str, Any]:
    """Returns the settings of a station in the file."""
    driver = found.driver
    return {"protocol": driver.protocol, "station": driver.station, **found.settings}


def noises(report: Report) -> Iterator[str]:
    """Yields a sentence for each speed and format with bytes that were no reply."""
    for serial, noise in report.noises.items():
        yield f"at {spoken(serial)} bytes arrived that are no reply: {noise}"
