"""The `bridge` commands: each is a program of its own between the gateways and another system."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.bridges.program import Gateways, packages_of, run
from gateway.cli.terminal import ROUTER, ZenohFile
from gateway.errors import ConfigError

cli = typer.Typer(help="Values to another system, and writes back.", no_args_is_help=True)

# Defaults of lists: typer copies them.
_ROUTERS, _BROKERS, _NOBODY = [ROUTER], ["mqtt://127.0.0.1:1883"], list[str]()
_SECURITY = ["sign", "encrypt"]
Connect = Annotated[
    list[str], typer.Option(metavar="ENDPOINT", help="The gateway or its router; several: spare.")
]
Prefix = Annotated[str, typer.Option(help="zenoh.prefix of the gateways.")]
Writes = Annotated[bool, typer.Option("--writes", help="Accept writes.")]


@cli.callback()
def commands() -> None:
    """Values to another system, and writes back."""


@cli.command()
def opcua(
    connect: Connect = _ROUTERS,
    zenoh: ZenohFile = None,
    prefix: Prefix = "plant",
    listen: Annotated[str, typer.Option(help="Address of the server.")] = (
        "opc.tcp://127.0.0.1:4840"
    ),
    users: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A line `name:token` for each user.")
    ] = None,
    anonymous: Annotated[
        bool, typer.Option("--anonymous", help="Let clients read without a user.")
    ] = False,
    writer: Annotated[
        list[str], typer.Option(metavar="NAME", help="A user that may write; several times.")
    ] = _NOBODY,
    writes: Annotated[bool, typer.Option("--writes", help="Every user may write.")] = False,
    security: Annotated[
        list[str],
        typer.Option(help="sign, encrypt or none; several times."),
    ] = _SECURITY,
    pki: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Certificates: own, trusted, rejected.")
    ] = Path("opcua-pki"),
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of the server (default: made in FOLDER).")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The private key of the certificate.")
    ] = None,
) -> None:
    """Serve values, alarms and history to OPC UA clients, and take writes from them."""
    with packages_of("bridge opcua"):
        from gateway.bridges.opcua.server import Options, bridge
    writers = None if writes else frozenset(writer)
    options = Options(listen, pki, certificate, key, security, users, writers, anonymous)
    run(bridge(Gateways(connect, zenoh, prefix), options))


@cli.command()
def mqtt(
    connect: Connect = _ROUTERS,
    zenoh: ZenohFile = None,
    prefix: Prefix = "plant",
    broker: Annotated[
        list[str], typer.Option(help="mqtt://host:port or mqtts://user@host; several: spare.")
    ] = _BROKERS,
    root: Annotated[
        str | None, typer.Option(help="The first levels of all topics (default: the prefix).")
    ] = None,
    expire: Annotated[
        int, typer.Option(help="Seconds until the broker forgets the values of a bridge that died.")
    ] = 60,
    writes: Writes = False,
    commands: Annotated[Path, typer.Option(help="The file with the ids of commands.")] = (
        Path("mqtt-commands.db")
    ),
    sparkplug: Annotated[
        str | None, typer.Option(metavar="GROUP", help="Sparkplug B in this group, not JSON.")
    ] = None,
    node: Annotated[
        str | None, typer.Option(help="The edge node of Sparkplug (default: the prefix).")
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="The primary host of Sparkplug: born only while it is there.")
    ] = None,
) -> None:
    """Publish the values to an MQTT broker, and take commands from it."""
    gateways = Gateways(connect, zenoh, prefix)
    if sparkplug is None:
        if node or host:
            raise ConfigError("--node and --host belong to --sparkplug")
        with packages_of("bridge mqtt"):
            from gateway.bridges.mqtt.bridge import bridge
        run(bridge(gateways, broker, root, expire, commands if writes else None))
    else:
        with packages_of("bridge mqtt"):
            from gateway.bridges.mqtt.sparkplug.bridge import bridge as sparkplug_bridge
        ids = sparkplug, node or prefix.replace("/", "-")
        run(sparkplug_bridge(gateways, broker, ids, host, writes))


@cli.command()
def influx(
    connect: Connect = _ROUTERS,
    zenoh: ZenohFile = None,
    prefix: Prefix = "plant",
    to: Annotated[
        str | None, typer.Option(help="Address of a write API (default: print the lines).")
    ] = None,
    every: Annotated[float, typer.Option(help="Seconds between two requests.")] = 1.0,
    queue: Annotated[int, typer.Option(help="Lines that may wait.")] = 500_000,
    state: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Recover what a restart has missed.")
    ] = None,
) -> None:
    """Send the values to InfluxDB, Telegraf, and what else takes their line protocol."""
    from gateway.bridges.influx.bridge import bridge

    run(bridge(Gateways(connect, zenoh, prefix), to, every, queue, state))
