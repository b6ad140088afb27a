"""Builds a line from its configuration."""

import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace

from gateway.config import LineConfig
from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.engine import Engine
from gateway.line.calling import ModemOpener
from gateway.line.line import Line, SampleSink
from gateway.line.opening import OpenPort
from gateway.line.rounds import ConnectionOpener
from gateway.line.send_permit import SendPermit
from gateway.simulator.plant import animate, station_for
from gateway.simulator.port import open_simulator
from gateway.stations.station import Station
from gateway.transport import (
    ModemAddress,
    Port,
    Receiver,
    SimulatorAddress,
    open_port,
    prepare,
)
from gateway.transport.listen_only import ListenOnlyPort


class SimulatedLine:
    """Opens the simulated devices of a line in memory. They keep their values when the line opens
    again, and when the file is reloaded."""

    def __init__(self, line: LineConfig) -> None:
        self._line = line
        self._devices: Sequence[DeviceSettings] = ()
        self._stations: list[Station] = []  # in the order of the devices; the open line uses it

    def __call__(self, receiver: Receiver) -> Awaitable[Port]:
        if not self._stations:  # made when the line opens: a large plant has many
            self._serve(self._line.devices)
        return open_simulator(self._stations, self._line.wire, receiver)

    def change(self, devices: Sequence[DeviceSettings]) -> None:
        """Takes over changed devices."""
        self._line = replace(self._line, devices=tuple(devices))
        if self._stations:
            self._serve(devices)

    def _serve(self, devices: Sequence[DeviceSettings]) -> None:
        known = {d.name: (d, s) for d, s in zip(self._devices, self._stations, strict=True)}
        stations = []
        for device in devices:
            before, station = known.get(device.name, (None, None))
            if before is None or station is None or before.driver != device.driver:
                station = station_for(device.driver, device.wire_tags)
            elif before is not device:
                spans = {tag.span for tag in before.wire_tags}
                animate(station, [tag for tag in device.wire_tags if tag.span not in spans])
            stations.append(station)
        self._devices, self._stations[:] = devices, stations


def opener(line: LineConfig) -> OpenPort:
    """Returns a function that opens the port of the line, or its simulated devices in memory."""
    if isinstance(line.port, SimulatorAddress):
        return SimulatedLine(line)
    prepare(line.port)
    if isinstance(line.port, ModemAddress) and line.modem is not None:
        return ModemOpener(line.port, line.serial, line.modem)
    if line.connect_delay or line.close_after:
        return ConnectionOpener(line.port, line.serial, line.connect_delay, bool(line.close_after))
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
    duty: SendPermit | None = None,
    plan_now: bool = True,
) -> Line:
    """Makes a line with some or all of its devices. `wall`: ns since 1970.

    Without `plan_now` each device needs `plan` before the line runs.
    """
    made = [Device(one, config.wire, plan_now=plan_now) for one in devices]
    engine = Engine(config.name, made, config.wire, seed)
    if not isinstance(config.port, SimulatorAddress):
        engine.inherits()
    opens = open_port or opener(config)
    if config.listen_only:
        opens = _without_writing(opens)
    return Line(engine, opens, sink, echo=config.echo, wall=wall, duty=duty)
