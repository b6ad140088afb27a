"""What the file says, checked and complete: plain data for the rest of the gateway."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from gateway.engine.device import DeviceSettings
from gateway.planning.wire_timing import WireTiming
from gateway.tags import Tag
from gateway.transport.port import PortAddress, SerialSettings, SimulatorAddress


class ZenohMode(StrEnum):
    PEER = "peer"
    CLIENT = "client"
    ROUTER = "router"


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsConfig:
    """Certificates (PEM files). `mutual`: both sides show one."""

    ca: Path | None = None  # whose certificates are believed
    certificate: Path | None = None
    key: Path | None = None
    mutual: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ZenohConfig:
    """The Zenoh session.

    `config_file` is a Zenoh JSON5 file for everything else. `mode` always counts; `listen`,
    `connect` and the others replace the settings of that file where they are given.
    """

    prefix: str = "plant"
    mode: ZenohMode = ZenohMode.PEER
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    config_file: Path | None = None
    tls: TlsConfig | None = None
    user: str | None = None  # of this gateway, where it connects to
    password_file: Path | None = None
    users_file: Path | None = None  # for those who connect: a line `user:password` each


@dataclass(frozen=True, slots=True, kw_only=True)
class HistoryConfig:
    """Where samples of tags with `history: true` are kept, how long (seconds), how many bytes."""

    path: Path
    keep: float
    max_size: int


@dataclass(frozen=True, slots=True, kw_only=True)
class WebConfig:
    """Where the status page listens."""

    host: str
    port: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LineConfig:
    """One wire and the devices on it."""

    name: str
    port: PortAddress
    serial: SerialSettings
    wire: WireTiming
    echo: bool | None  # whether the port hears what it says; None: not said
    devices: tuple[DeviceSettings, ...]

    @property
    def simulated(self) -> bool:
        return isinstance(self.port, SimulatorAddress)

    @property
    def tags(self) -> tuple[Tag, ...]:
        return tuple(tag for device in self.devices for tag in device.tags)


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """One whole file. `history` and `web` are None where the file has no such section."""

    name: str
    state_file: Path | None = None  # what was learned of the devices, kept across restarts
    standby: str | None = None  # the group of gateways that stand in for one another
    standby_alone: float | None = None  # seconds without a link until it goes on the wire anyway
    writers_file: Path | None = None  # None: whoever Zenoh lets through may write
    zenoh: ZenohConfig
    history: HistoryConfig | None
    web: WebConfig | None
    lines: tuple[LineConfig, ...]

    @property
    def devices(self) -> tuple[DeviceSettings, ...]:
        return tuple(device for line in self.lines for device in line.devices)
