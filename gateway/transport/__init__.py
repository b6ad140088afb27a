"""Ports: serial, TCP and RFC 2217, opened by `open_port`."""

from importlib import import_module

from gateway.transport.port import (
    Port,
    PortAddress,
    Receiver,
    Rfc2217Address,
    SerialPath,
    SerialSettings,
    SimulatorAddress,
    TcpAddress,
    parse_port,
)

_OPENERS = {SerialPath: "serial_port", TcpAddress: "tcp", Rfc2217Address: "rfc2217"}


def prepare(where: PortAddress) -> None:
    """Imports what opens the port. It takes as long as a reply, so it precedes the first line; a
    process that opens no port does without."""
    if module := _OPENERS.get(type(where)):
        import_module(f"{__name__}.{module}")


async def open_port(
    where: PortAddress, settings: SerialSettings, receiver: Receiver, *, timeout: float = 5.0
) -> Port:
    """Opens the port; `receiver` gets the received bytes. `timeout` is in seconds.

    Raises `LineDown` with a sentence for people. The line, not this package, reopens a lost port.
    `open_simulator` opens the simulator, which needs its stations.
    """
    match where:
        case SerialPath():
            from gateway.transport.serial_port import open_serial

            return await open_serial(where, settings, receiver, timeout=timeout)
        case TcpAddress():
            from gateway.transport.tcp import open_tcp

            return await open_tcp(where, receiver, timeout=timeout, baudrate=settings.baudrate)
        case Rfc2217Address():
            from gateway.transport.rfc2217 import open_rfc2217

            return await open_rfc2217(where, settings, receiver, timeout=timeout)
        case SimulatorAddress():
            raise ValueError("a simulator needs its stations: open_simulator")


__all__ = [
    "Receiver",
    "Port",
    "PortAddress",
    "Rfc2217Address",
    "SerialPath",
    "SerialSettings",
    "SimulatorAddress",
    "TcpAddress",
    "open_port",
    "parse_port",
    "prepare",
]
