"""Ports: serial, TCP, UDP and RFC 2217 by `open_port`, and modems on them by `open_modem`."""

from collections.abc import Awaitable, Callable
from importlib import import_module
from typing import TYPE_CHECKING

from gateway.errors import LineDown
from gateway.transport.modem_events import ModemSettings
from gateway.transport.port import (
    ListenAddress,
    ModemAddress,
    Port,
    PortAddress,
    Receiver,
    Rfc2217Address,
    SerialPath,
    SerialSettings,
    SimulatorAddress,
    TcpAddress,
    UdpAddress,
    named,
    parse_port,
)

if TYPE_CHECKING:
    from gateway.transport.modem import ModemPort

_OPENERS = {
    SerialPath: "serial_port",
    TcpAddress: "tcp",
    UdpAddress: "udp",
    ListenAddress: "device_servers",
    Rfc2217Address: "rfc2217",
    ModemAddress: "modem",
}


def prepare(where: PortAddress) -> None:
    """Imports what opens the port. It takes as long as a reply, so it precedes the first line; a
    process that opens no port does without."""
    if module := _OPENERS.get(type(where)):
        import_module(f"{__name__}.{module}")
    if isinstance(where, ModemAddress):
        prepare(where.port)


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
        case UdpAddress():
            from gateway.transport.udp import open_udp

            return await open_udp(where, receiver, timeout=timeout)
        case Rfc2217Address():
            from gateway.transport.rfc2217 import open_rfc2217

            return await open_rfc2217(where, settings, receiver, timeout=timeout)
        case ListenAddress():
            from gateway.transport.device_servers import open_listen

            return await open_listen(where, receiver, timeout=timeout, baudrate=settings.baudrate)
        case ModemAddress():
            raise LineDown("a modem dials for a line of a file only")
        case SimulatorAddress():
            raise ValueError("a simulator needs its stations: open_simulator")


OpenBelow = Callable[[PortAddress, SerialSettings, Receiver], Awaitable[Port]]


async def open_modem(
    where: ModemAddress,
    settings: SerialSettings,
    modem: ModemSettings,
    receiver: Receiver,
    *,
    answers: bool = False,
    opens: OpenBelow = open_port,
) -> "ModemPort":
    """Opens the port of a modem, and sets the modem up. As `open_port`.

    `answers`: the modem takes incoming calls. `opens` opens the port that the modem is at.
    """
    from gateway.transport.modem import ModemPort

    port = ModemPort(_name(where), modem, receiver, answers=answers)
    await port.open(lambda below: opens(where.port, settings, below))
    return port


def _name(where: ModemAddress) -> str:
    match where.port:
        case SerialPath(path):
            return path
        case TcpAddress(host, port) | Rfc2217Address(host, port):
            return named(host, port)
