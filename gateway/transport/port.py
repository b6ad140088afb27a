"""The port contract, and port addresses as the configuration file writes them."""

import re
from collections.abc import Container
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path
from typing import Protocol, runtime_checkable

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


@runtime_checkable
class Noted(Protocol):
    """A port that was opened, but not as the file says."""

    @property
    def note(self) -> str:
        """Why its devices may not answer, one sentence; empty: nothing is known."""


@runtime_checkable
class Adjustable(Protocol):
    """A port whose speed, format and modem lines can be changed while it is open."""

    async def adjust(self, setting: int, value: int) -> int:
        """Changes a setting of RFC 2217, such as `telnet.Setting.BAUDRATE`, when all bytes have
        been sent. Returns the value that the port has now. Never raises."""


@dataclass(frozen=True, slots=True)
class SerialPath:
    """A local serial port: `/dev/ttyUSB0`."""

    path: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsConfig:
    """Certificates (PEM files). `mutual`: both sides show one."""

    ca: Path | None = None  # certificate authority to trust
    certificate: Path | None = None
    key: Path | None = None
    mutual: bool = False
    revoked: Path | None = None  # the list of certificates that the authority has revoked
    name: str = ""  # of the other side, in its certificate; empty: its host
    writers: tuple[str, ...] = ()  # the roles of masters that may write; empty: all may

    def check(self) -> None:
        """Raises `ConfigError` for settings that do not go together."""
        if (self.certificate is None) is not (self.key is None):
            raise ConfigError("certificate and key belong together")
        if self.mutual and (self.ca is None or self.certificate is None):
            raise ConfigError("mutual needs ca, certificate and key")


KEEPALIVE = 20.0  # seconds of silence until the system asks if the other side is there


@dataclass(frozen=True, slots=True)
class Reach:
    """The way to make a connection. `others`: more addresses of the same device server."""

    others: tuple[tuple[str, int], ...] = ()
    bind: str = ""  # the address of this computer; empty: the system chooses
    keepalive: float = KEEPALIVE  # seconds


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """A device server in raw mode, or a device with a network port: `tcp://host:port`, and
    `tls://host:port` with certificates."""

    host: str
    port: int
    tls: TlsConfig | None = None
    reach: Reach = Reach()


@dataclass(frozen=True, slots=True)
class UdpAddress:
    """A device with a network port that takes datagrams: `udp://host:port`."""

    host: str
    port: int


@dataclass(frozen=True, slots=True)
class Rfc2217Address:
    """A device server that accepts baud rate and format: `rfc2217://host:port`."""

    host: str
    port: int
    reach: Reach = Reach()


def named(host: str, port: int) -> str:
    """Returns an address as people write it: `10.0.0.7:502`, `[fe80::1]:502`."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


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
    name: str = ""  # in its certificate; empty: any of the authority

    @property
    def words(self) -> tuple[bytes, ...]:
        """The bytes that it sends by itself: none are of the line. Some register each time."""
        return tuple(word for word in (self.registration, self.heartbeat) if word)

    def allows(self, address: str) -> bool:
        return allows(self.networks, address)

    def is_named(self, names: Container[str]) -> bool:
        """`names`: in a certificate, in lower case."""
        return not self.name or self.name.lower() in names


@dataclass(frozen=True, slots=True)
class ListenAddress:
    """A port of this machine that device servers connect to: `listen://host:port`."""

    host: str
    port: int
    server: DeviceServer = DeviceServer()
    tls: TlsConfig | None = None


@dataclass(frozen=True, slots=True)
class ModemAddress:
    """A modem at a serial port or device server: `modem:/dev/ttyS0`."""

    port: SerialPath | TcpAddress | Rfc2217Address


@dataclass(frozen=True, slots=True)
class SimulatorAddress:
    """The built-in simulated PLCs, in memory."""


PortAddress = (
    SerialPath
    | TcpAddress
    | UdpAddress
    | Rfc2217Address
    | ListenAddress
    | ModemAddress
    | SimulatorAddress
)


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Baud rate and character format of a serial port; `format` as in `7E1`."""

    baudrate: int = 9600
    format: str = "8N1"
    rs485: Rs485 | None = None  # None: the adapter switches by itself, or has wires for each way


LONGEST_REGISTRATION = 256  # bytes
MODEM = "modem:"
_URL = re.compile(
    r"(tcp|tls|udp|rfc2217|listen)://(\[[0-9A-Fa-f:.%]+\]|[^\[\]/:\s]+):([0-9]{1,5})\Z"
)
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")


def parse_port(text: str) -> PortAddress:
    """Parses a port as the file writes it. Raises `ConfigError`."""
    if text == "simulator":
        return SimulatorAddress()
    if text.startswith(MODEM):
        below = parse_port(text.removeprefix(MODEM))
        if not isinstance(below, SerialPath | TcpAddress | Rfc2217Address):
            raise ConfigError(f"{text!r} is not a modem: write its port, such as modem:/dev/ttyS0")
        return ModemAddress(below)
    if match := _URL.match(text):
        scheme, host, port = match[1], match[2].strip("[]"), int(match[3])
        if not 1 <= port <= 65535:
            raise ConfigError(f"port number {port} is not 1..65535")
        if scheme == "listen":
            return ListenAddress(host, port)
        if scheme == "udp":
            return UdpAddress(host, port)
        if scheme == "rfc2217":
            return Rfc2217Address(host, port)
        return TcpAddress(host, port, TlsConfig() if scheme == "tls" else None)
    if _SCHEME.match(text) or not text.strip() or text != text.strip():
        raise ConfigError(
            f"{text!r} is not a port: write a path such as /dev/ttyUSB0, "
            "tcp://host:port, tls://host:port, udp://host:port, rfc2217://host:port, "
            "listen://host:port, modem:/dev/ttyS0, or simulator"
        )
    return SerialPath(text)
