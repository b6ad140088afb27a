"""The `replay` command: what a recording tells, and if this version still reads it the same."""

import asyncio
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.line.capture import Capture
from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.line.peek import SettingOption
from gateway.cli.line.recorded_line import Log, line_of_file, line_of_protocols
from gateway.cli.line.simulate import tcp_address
from gateway.cli.tables import print_rows, row_of
from gateway.cli.terminal import FAILED, AsJson, printable
from gateway.cli.trace import clock
from gateway.config import LineConfig
from gateway.ending import stop_event
from gateway.errors import ConfigError, GatewayError
from gateway.line.exchanges import shown
from gateway.parts.recording.replay import Difference, Learned, Replay, courses, of_units, timed
from gateway.parts.recording.wire_file import LoggedPiece, LoggedValue
from gateway.protocols.listening import Listenable
from gateway.simulator.recorded import Answered, OtherStations, RecordedStation, RecordedValues
from gateway.simulator.serve import serve_on_pty, serve_on_tcp
from gateway.stations.station import Station

Show = Callable[[Learned], None]


def replay(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOG...", help="Files of a recording, or its folder.")
    ],
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="The YAML file of the line.")
    ] = None,
    line: Annotated[
        str | None, typer.Option("--line", help="The line; left out: that of the recording.")
    ] = None,
    protocol: Annotated[
        list[str] | None,
        typer.Option(help="Without --config: vigor, modbus-rtu ...; left out: as noted."),
    ] = None,
    setting: SettingOption = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only compare with the values in the recording.")
    ] = False,
    pcapng: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the bytes for Wireshark instead.")
    ] = None,
    as_plant: Annotated[
        bool, typer.Option("--serve", help="Serve it as simulated PLCs, on a pty.")
    ] = False,
    tcp: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Serve it on TCP instead.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Decode a recording: the values of each reply, with its time. Sends nothing.

    Without --config each address has its own name, as the PLC has it.
    """
    show = _print_json if as_json else _print
    log = Log(logs, line)
    if config is None:
        of = line_of_protocols(log, protocol or [], setting or [])
    elif protocol or setting:
        raise ConfigError("with --config, its settings are used: leave out --protocol and --set")
    else:
        of = line_of_file(config, log)
    if as_plant or tcp is not None:
        set_up(LogFormat.TEXT, LogLevel.INFO)
        serve(of, list(timed(log.entries())), tcp)
    elif pcapng is not None:
        with Capture(pcapng, of) as capture:
            for entry in log.entries():
                if isinstance(entry, LoggedPiece):
                    capture.add(entry.at or 0.0, entry.way, entry.data)
    elif config is None:
        _decode(of, log, check=check, show=show)
    else:
        _compare(of, log.entries(), check=check, show=show)


def _decode(line: LineConfig, log: Log, *, check: bool, show: Show) -> None:
    if check:
        raise ConfigError("--check needs --config: the names of the values are in the file")
    events = (one for one in Replay(line).run(timed(log.entries())) if isinstance(one, Learned))
    learned = False
    for event in events:
        learned = True
        show(event)
    if not learned:
        raise GatewayError(
            "nothing was learned: no reply belongs to its request for certain. Is there another "
            "protocol on the line too? Name each with --protocol"
        )


def _compare(
    line: LineConfig, log: Iterable[LoggedPiece | LoggedValue], *, check: bool, show: Show
) -> None:
    replayed = Replay(line)
    for event in replayed.run(log):
        if isinstance(event, Difference):
            at, tag, value = event.logged
            now = json.dumps(event.learned, ensure_ascii=False)
            print(f"{clock(at)} {tag}: {json.dumps(value, ensure_ascii=False)} recorded, {now} now")
        elif not check:
            show(event)
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


def _print(event: Learned) -> None:
    for text in _lines(event):
        print(printable(text))


def _print_json(event: Learned) -> None:
    print_rows([row_of(sample) for sample in event.samples], {}, as_json=True)


def _lines(event: Learned) -> Iterator[str]:
    """Returns the good values of a reply, and each reason of bad ones."""
    good = [sample for sample in event.samples if sample.value is not None]
    if good:
        yield f"{clock(event.at)} {good[0].tag.device}: {shown(good)}"
    for sample in event.samples:
        if sample.value is None:
            yield f"{clock(event.at)} {sample.tag.key}: bad, {sample.reason}: {sample.detail}"


_SHOWN = 5  # addresses that the recording does not hold


def serve(line: LineConfig, log: Sequence[LoggedPiece], tcp: str | None) -> None:
    """Serves the values of the log until SIGTERM or SIGINT. `tcp`: HOST:PORT instead of a pty.

    Raises `GatewayError` for a log without values, and for a place that cannot be used.
    """
    units = of_units(line, log)
    found = courses(units, log) if units.devices else {}
    if not any(course.changes for course in found.values()):
        raise GatewayError("the recording holds no value of this line")
    answered = Answered()
    asyncio.run(_serve(units, found, log[0].at or 0.0, tcp, answered, partial(print, flush=True)))
    print(report(answered))


def stations_of(
    line: LineConfig, found: Mapping[str, RecordedValues], begin: float, answered: Answered
) -> list[Station]:
    """Returns the simulated PLCs of a line of units. `begin`: time of the first byte."""
    drivers = [device.driver for device in line.devices]
    readers = [driver for driver in drivers if isinstance(driver, Listenable)]
    others = OtherStations(readers, {driver.station for driver in drivers}, answered)
    recorded = [
        RecordedStation(device.driver, found[device.name], begin, answered)
        for device in line.devices
    ]
    return [*recorded, others]


async def _serve(
    line: LineConfig,
    found: Mapping[str, RecordedValues],
    begin: float,
    tcp: str | None,
    answered: Answered,
    say: Callable[[str], None],
) -> None:
    stop = stop_event()
    stations = stations_of(line, found, begin, answered)
    over_network = any(device.driver.traits.over_network for device in line.devices)
    if tcp is None and not over_network:
        served = await serve_on_pty(stations, line.wire)
    else:
        place = ("127.0.0.1", 0) if tcp is None else tcp_address(tcp)
        served = await serve_on_tcp(stations, line.wire, *place, paced=not over_network)
    try:
        for device in line.devices:
            course = found[device.name]
            last = max((change.at for change in course.changes), default=begin)
            say(
                f"{device.name}: station {device.driver.station}, {len(course.first)} addresses, "
                f"{len(course.changes)} values in {last - begin:.0f} s"
            )
        needs = "a line that reads it needs `origin: replayed`"
        say(f"at {served.address}; {needs}; Ctrl-C ends it.")
        await stop.wait()
    finally:
        await served.close()


def report(answered: Answered) -> str:
    """Returns how many requests came, and which the recording does not hold."""
    unknown = answered.unknown
    text = f"{answered.requests} requests, {unknown.total()} for what the recording does not hold"
    if not unknown:
        return text
    shown = ", ".join(f"{what} ({count})" for what, count in unknown.most_common(_SHOWN))
    more = f" and {len(unknown) - _SHOWN} more" if len(unknown) > _SHOWN else ""
    return f"{text}: {shown}{more}"
