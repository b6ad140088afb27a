"""Serves a recording as simulated PLCs."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from gateway.cli.line.simulate import stop_event, tcp_address
from gateway.config import LineConfig
from gateway.errors import GatewayError
from gateway.parts.recording.recorded import courses, of_units
from gateway.parts.recording.wire_file import LoggedPiece
from gateway.protocols.listening import Listenable
from gateway.simulator.recorded import Answered, Course, OtherStations, RecordedStation
from gateway.simulator.serve import serve_on_pty, serve_on_tcp
from gateway.stations.station import Station

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
    line: LineConfig, found: Mapping[str, Course], begin: float, answered: Answered
) -> list[Station]:
    """Returns the simulated PLCs of a line of units. `begin`: time of the first byte."""
    drivers = [device.driver for device in line.devices]
    ears = [driver for driver in drivers if isinstance(driver, Listenable)]
    others = OtherStations(ears, {driver.station for driver in drivers}, answered)
    recorded = [
        RecordedStation(device.driver, found[device.name], begin, answered)
        for device in line.devices
    ]
    return [*recorded, others]


async def _serve(
    line: LineConfig,
    found: Mapping[str, Course],
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
        say(f"at {served.address}; Ctrl-C ends it.")
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
