"""Builds a line from its configuration."""

import time
from collections.abc import Awaitable, Callable, Sequence

from gateway.config import LineConfig
from gateway.engine.device import Device, DeviceSettings
from gateway.engine.engine import Engine
from gateway.line.duty import Duty
from gateway.line.line import Line, SampleSink
from gateway.simulator.plant import station_for
from gateway.simulator.port import open_simulator
from gateway.stations.station import Station
from gateway.transport import Port, Receiver, SimulatorAddress, open_port
from gateway.transport.listen_only import ListenOnlyPort

OpenPort = Callable[[Receiver], Awaitable[Port]]


def opener(line: LineConfig) -> OpenPort:
    """Returns a function that opens the port of the line, or its simulated devices in memory."""
    if isinstance(line.port, SimulatorAddress):
        stations: list[Station] = []  # they keep their values when the line opens again

        def simulated(receiver: Receiver) -> Awaitable[Port]:
            if not stations:  # made when the line opens: a large plant has many
                stations.extend(station_for(one.driver, one.wire_tags) for one in line.devices)
            return open_simulator(stations, line.wire, receiver)

        return simulated
    return lambda receiver: open_port(line.port, line.serial, receiver)


def _without_writing(opens: OpenPort) -> OpenPort:
    """Returns an opener whose ports can write nothing. The rule of listen-only lines is here."""

    async def listening(receiver: Receiver) -> Port:
        return ListenOnlyPort(await opens(receiver))

    return listening


def line_of(
    config: LineConfig,
    devices: Sequence[DeviceSettings],
    sink: SampleSink,
    *,
    open_port: OpenPort | None = None,
    wall: Callable[[], int] = time.time_ns,
    seed: int = 0,
    duty: Duty | None = None,
    plan_now: bool = True,
) -> Line:
    """Makes a line with some or all of its devices. `wall`: ns since 1970.

    Without `plan_now` each device needs `plan` before the line runs.
    """
    made = [Device(one, config.wire, plan_now=plan_now) for one in devices]
    engine = Engine(config.name, made, config.wire, seed)
    opens = open_port or opener(config)
    if config.listen_only:
        opens = _without_writing(opens)
    return Line(engine, opens, sink, echo=config.echo, wall=wall, seed=seed, duty=duty)
