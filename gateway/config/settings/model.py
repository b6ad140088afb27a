"""The sections of the file as pydantic sees them: name, type and meaning of every setting.

An editor shows the descriptions. Mistakes that need more than one setting (an address that the
device does not have, two stations with one number) are found by `gateway.config.build`.
"""

from ipaddress import IPv4Network, IPv6Network
from typing import Annotated, Any, Literal

from pydantic import Field

from gateway.config.settings import parsers
from gateway.config.settings.modem_settings import ModemSection
from gateway.config.settings.session_model import (
    GatewaySection,
    Section,
    TlsSection,
    ZenohSection,
)
from gateway.config.settings.setting_types import (
    FORMAT_SCHEMA,
    IDENTITY_SCHEMA,
    NETWORKS_SCHEMA,
    SENT_BYTES_SCHEMA,
    Baudrate,
    Duration,
    FilePath,
    Interval,
    Parsed,
    Port,
    Text,
    WebAddress,
)
from gateway.tags.tag import NotReal
from gateway.transport.port import KEEPALIVE, TlsConfig


class WritersSection(Section):
    """The clients that may write, by their secrets."""

    file: FilePath
    """One line `name:secret` for each client; see docs/security.md."""


class DeviceSection(Section):
    """Settings of a device that do not depend on its protocol."""

    reply_timeout: Interval | None = None
    """Time-out from request to reply, without the time of the characters on the wire."""
    turnaround: Duration | None = None
    """Usual time from request to reply; left out: measured."""
    silence: Duration | None = None
    """Pause on the line before each request; left out: learned, where no standard asks for it."""
    retries: Annotated[int, Field(ge=0, le=10)] | None = None
    """Repetitions of a failed read; writes are not repeated."""
    verify_reads: Annotated[int, Field(ge=1, le=3)] = 1
    """The number of equal reads in a row before a value counts."""
    late_guard: Duration | None = None
    """The longest wait for a late reply after a time-out, before the next request."""
    identity: Annotated[dict[str, str] | None, Parsed(parsers.identity, IDENTITY_SCHEMA)] = None
    """Vendor, model or serial number that the device must tell, or the value of a tag."""
    blocks: Annotated[
        bool | Literal["only"], Parsed(parsers.blocks, {"enum": [True, False, "only"]})
    ] = False
    """One put per scan with all changed tags, at <device>/@block: true adds it, only replaces."""
    control: bool = False
    """Permission for commands to the device, such as run and stop."""
    enabled: bool = True
    """false: the device stays in the file and gets no requests."""
    accept: list[Text] = []
    """On a served line: the addresses that the master may write, such as D100..D119."""
    stale_after: Interval | None = None
    """On a served line: what the master wrote turns bad when it sends no request for so long."""
    defaults: dict[str, Any] = {}
    tags: dict[str, Any] = {}
    """The values of the device, by name."""
    tags_from: FilePath | None = None
    """A sheet with more tags of the device, or a project: docs/import.md."""


class Rs485Section(Section):
    """An RS-485 transceiver that RTS switches between sending and receiving."""

    by: Literal["kernel", "program"] = "kernel"
    """The kernel switches within microseconds; the gateway where the driver cannot."""
    rts: Literal["send", "receive"] = "send"
    """RTS is on while the port sends, or while it receives."""
    before: Duration = 0.0
    """From switching to the first bit; whole milliseconds, at most 100ms."""
    after: Duration = 0.0
    """From the last bit to switching back; whole milliseconds, at most 100ms."""


class DeviceServerSection(Section):
    """The device server that connects to a port `listen://host:port`: docs/device-servers.md."""

    registration: Annotated[bytes | None, Parsed(parsers.sent_bytes, SENT_BYTES_SCHEMA)] = None
    """The bytes that it sends first, such as DTU-0042; left out: every connection is taken."""
    heartbeat: Annotated[bytes | None, Parsed(parsers.sent_bytes, SENT_BYTES_SCHEMA)] = None
    """The bytes that it sends now and then, such as ping: they are no part of a reply."""
    allow: Annotated[
        tuple[IPv4Network | IPv6Network, ...] | None, Parsed(parsers.networks, NETWORKS_SCHEMA)
    ] = None
    """The addresses that may connect, such as [10.1.0.0/16]; left out: all."""


class ConnectionSection(Section):
    """The connection to a device server: docs/connections.md."""

    also: list[WebAddress] = []
    """More addresses of the same device server, such as 10.1.0.7:4001: tried in turn."""
    bind: Annotated[str, Parsed(parsers.local_address, {"type": "string"})] = ""
    """The address of this computer to connect from; left out: the system chooses."""
    keepalive: Interval = KEEPALIVE
    """Silence after which the system asks if the device server is there; 1s to 1h."""


class LineTlsSection(TlsSection):
    """TLS of a port `tls://host:port` or `listen://host:port`: docs/connections.md."""

    revoked: FilePath | None = None
    """The list of the certificates that the authority has revoked, a PEM file."""
    name: Text = ""
    """The name in the certificate of the other side; left out: the host of the port."""
    writers: list[Text] = []
    """With serve, and at a door: the roles that may write; left out: all."""

    def record(self) -> TlsConfig:
        return TlsConfig(**dict(self) | {"writers": tuple(self.writers)})


class LineSection(Section):
    """One line and the devices on it."""

    port: Port
    """A serial port, tcp://host:port, tls://host:port, udp://host:port, rfc2217://host:port,
    listen://host:port, modem:<port>, or simulator."""
    baudrate: Baudrate = None
    """Speed of the line, also behind a device server; left out: the default of the protocol."""
    format: Annotated[str | None, Parsed(parsers.serial_format, FORMAT_SCHEMA)] = None
    """Data bits, parity, stop bits: 7E1, 8N1; left out: the default of the protocol."""
    origin: NotReal | None = None
    """Of a port that leads to no real device: simulated PLCs, or a recording that is replayed."""
    echo: bool | None = None
    """true: the port receives its own requests, as with some two-wire RS-485 converters."""
    rs485: Rs485Section | None = None
    """Has Linux switch the RS-485 transceiver of a serial port; left out: it switches by itself."""
    device_server: DeviceServerSection | None = None
    """Of a port `listen://…`: which device server this line waits for."""
    tls: LineTlsSection | None = None
    """Of a port `tls://…` or `listen://…`: its certificates."""
    connection: ConnectionSection | None = None
    """Of a port tcp://, tls:// or rfc2217://: how the connection is made."""
    serve: bool = False
    """true: the devices are stations of this gateway, and a master on the line asks them."""
    request_gap: Duration | None = None
    """With serve: the longest pause within a request; left out: by the speed, 2 s with a modem."""
    listen_only: bool = False
    """true: learns the values from another master's traffic, and sends nothing, ever."""
    modem: ModemSection | None = None
    """The modem of a port `modem:…`, and its calls: docs/modem.md."""
    connect_delay: Duration = 0.0
    """From the connection to the first request, for a slow device server; at most 10s."""
    close_after: Literal["round"] | None = None
    """round: connects when polls are due or a client asks, and closes after them."""
    defaults: dict[str, Any] = {}
    devices: dict[str, Any]
    """The devices on this line, by name."""


class FileSection(Section):
    """A gateway between PLCs and Zenoh."""

    gateway: GatewaySection = GatewaySection()
    zenoh: ZenohSection = ZenohSection()
    writers: WritersSection | None = None
    templates: dict[str, Any] = {}
    """Devices with parameters, which devices `use`: docs/templates.md."""
    templates_from: str | list[str] = []
    """Files with more templates."""
    defaults: dict[str, Any] = {}
    lines: dict[str, Any]
    """The lines, by name."""
    transfers: list[Any] = []
    """Values that the gateway reads from one PLC and writes to another: docs/transfers.md."""
