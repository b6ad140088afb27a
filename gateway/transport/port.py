"""The port contract, and port addresses as the configuration file writes them."""

import re
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Protocol

from gateway.errors import ConfigError
from gateway.transport.rs485 import Rs485


class Receiver(Protocol):
    """Gets the bytes and the loss of a port. Called on the event loop."""

    def received(self, data: bytes) -> None: ...

    def lost(self, error: Exception) -> None:
        """Reports the loss of the port: called once, never after `close`.

        With `CallEnded` a modem reports the loss of one call.
        """


class Port(Protocol):
    """An open port. Bytes that arrive go to the `Receiver` it was opened with."""

    def write(self, data: bytes) -> None:
        """Hands the bytes to the system and returns at once. Raises `LineDown`."""

    async def close(self) -> None:
        """Closes the port; never raises."""


@dataclass(frozen=True, slots=True)
class SerialPath:
    """A local serial port: `/dev/ttyUSB0`."""

    path: str


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """A device server in raw mode, or a device with a network port: `tcp://host:port`."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class Rfc2217Address:
    """A device server that accepts baud rate and format: `rfc2217://host:port`."""

    host: str
    port: int


def is_loopback(host: str) -> bool:
    """Returns True if no other machine can reach the address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


Networks = tuple[IPv4Network | IPv6Network, ...]


def allows(networks: Networks, address: str) -> bool:
    """Returns True if the address is in one of the networks, or there are none."""
    found = ip_address(address.partition("%")[0])
    found = getattr(found, "ipv4_mapped", None) or found
    return not networks or any(found in one for one in networks)


@dataclass(frozen=True, slots=True)
class DeviceServer:
    """Which device server a line waits for at its port `listen://…`, and what it sends by itself.

    Without a registration every connection is taken. Without networks every address is allowed.
    """

    registration: bytes = b""
    heartbeat: bytes = b""
    networks: Networks = ()

    @property
    def words(self) -> tuple[bytes, ...]:
        """The bytes that it sends by itself: none are of the line. Some register each time."""
        return tuple(word for word in (self.registration, self.heartbeat) if word)

    def allows(self, address: str) -> bool:
        return allows(self.networks, address)


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """A port of this machine that device servers connect to: `listen://host:port`."""

    host: str
    port: int
    server: DeviceServer = DeviceServer()


@dataclass(frozen=True, slots=True)
class ModemAddress:
    """A modem at a serial port or device server: `modem:/dev/ttyS0`."""

    port: SerialPath | TcpAddress | Rfc2217Address


@dataclass(frozen=True, slots=True)
class SimulatorAddress:
    """The built-in simulated PLCs, in memory."""


PortAddress = (
    SerialPath | TcpAddress | Rfc2217Address | ListenAddress | ModemAddress | SimulatorAddress
)


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Baud rate and character format of a serial port; `format` as in `7E1`."""

    baudrate: int = 9600
    format: str = "8N1"
    rs485: Rs485 | None = None  # None: the adapter switches by itself, or has wires for each way


LONGEST_REGISTRATION = 256  # bytes
MODEM = "modem:"
_URL = re.compile(r"(tcp|rfc2217|listen)://(\[[0-9A-Fa-f:.%]+\]|[^\[\]/:\s]+):([0-9]{1,5})\Z")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def parse_port(text: str) -> PortAddress:
    """Parses a port as the file writes it. Raises `ConfigError`."""
    if text == "simulator":
        return SimulatorAddress()
    if text.startswith(MODEM):
        below = parse_port(text.removeprefix(MODEM))
        if isinstance(below, ListenAddress | ModemAddress | SimulatorAddress):
            raise ConfigError(f"{text!r} is not a modem: write its port, such as modem:/dev/ttyS0")
        return ModemAddress(below)
    if match := _URL.match(text):
        scheme, host, port = match[1], match[2].strip("[]"), int(match[3])
        if not 1 <= port <= 65535:
            raise ConfigError(f"port number {port} is not 1..65535")
        if scheme == "listen":
            return ListenAddress(host, port)
        return TcpAddress(host, port) if scheme == "tcp" else Rfc2217Address(host, port)
    if _SCHEME.match(text) or not text.strip() or text != text.strip():
        raise ConfigError(
            f"{text!r} is not a port: write a path such as /dev/ttyUSB0, "
            "tcp://host:port, rfc2217://host:port, listen://host:port, modem:/dev/ttyS0, or "
            "simulator"
        )
    return SerialPath(text)
