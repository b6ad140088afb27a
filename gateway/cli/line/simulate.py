"""The `simulate` command: serves the configured devices as simulated PLCs."""

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.line.logs import LogFormat, LogLevel, set_up
from gateway.cli.progress import loaded
from gateway.cli.terminal import ConfigPath
from gateway.config import Config, LineConfig
from gateway.ending import stop_event
from gateway.errors import ConfigError
from gateway.planning.wire_timing import NETWORK_BAUD
from gateway.simulator.plant import station_for
from gateway.simulator.serve import Served, serve_on_pty, serve_on_tcp
from gateway.transport import TcpAddress


def simulate(
    config: ConfigPath,
    tcp: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve on TCP: first line here, next port up"),
    ] = None,
    links: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Make a link to the pty of each line in DIR")
    ] = None,
) -> None:
    """Serve the configured devices as simulated PLCs on ptys or TCP ports."""
    plant = loaded(config)
    set_up(LogFormat.TEXT, LogLevel.INFO)
    asyncio.run(serve(plant, tcp, links, partial(print, flush=True)))


async def serve(
    config: Config, tcp: str | None, links: Path | None, say: Callable[[str], None]
) -> None:
    """Serves every line until SIGTERM or SIGINT.

    A line with a `tcp://` port uses that port of this machine, other lines use a pty. With `tcp`
    (HOST:PORT) all lines use TCP ports from that one upwards. Raises `ConfigError`, `LineDown`.
    """
    if links is not None and not links.is_dir():
        raise ConfigError(f"--links {links}: there is no such folder: make it first")
    stop = stop_event()
    host, port = (None, 0) if tcp is None else tcp_address(tcp)
    async with AsyncExitStack() as stack:
        for offset, line in enumerate(line for line in config.lines if not line.serve):
            place = None if host is None else (host, port + offset)
            served = await _serve(line, place, links)
            stack.push_async_callback(served.close)
            stations = ", ".join(str(device.driver.station) for device in line.devices)
            say(f"line {line.name}: stations {stations} at {served.address}")
        say("A line that reads them needs `origin: simulated`. Ctrl-C ends it.")
        await stop.wait()


async def _serve(line: LineConfig, place: tuple[str, int] | None, links: Path | None) -> Served:
    stations = [station_for(device.driver, device.wire_tags) for device in line.devices]
    if place is None and isinstance(line.port, TcpAddress):
        place = ("127.0.0.1", line.port.port)
    if place is not None:
        wired = line.wire.baudrate != NETWORK_BAUD
        return await serve_on_tcp(stations, line.wire, *place, paced=wired)
    link = None if links is None else str(links / line.name)
    return await serve_on_pty(stations, line.wire, link)


def tcp_address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 1 <= int(port) <= 65535:
        raise ConfigError(f"--tcp {text}: write it as 127.0.0.1:4001")
    return host, int(port)
