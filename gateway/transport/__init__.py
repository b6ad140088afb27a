"""The one place that touches a port: `open_port` for serial ports, TCP and RFC 2217."""

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
from gateway.transport.rfc2217 import open_rfc2217
from gateway.transport.serial_port import open_serial
from gateway.transport.tcp import open_tcp


async def open_port(
    where: PortAddress, settings: SerialSettings, ear: Receiver, *, timeout: float = 5.0
) -> Port:
    """Open the port; from now on `ear` hears it. `timeout` is in seconds.

    Raises `LineDown` with a sentence for people. Nobody reopens a port here: that is the
    line's business. A simulator is opened by `open_simulator`, with its stations.
    """
    match where:
        case SerialPath():
            return await open_serial(where, settings, ear, timeout=timeout)
        case TcpAddress():
            return await open_tcp(where, ear, timeout=timeout)
        case Rfc2217Address():
            return await open_rfc2217(where, settings, ear, timeout=timeout)
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
]
