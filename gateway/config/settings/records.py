"""The checked and complete configuration: plain data for the rest of the gateway."""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from gateway.config.settings.zenoh_records import ZenohConfig
from gateway.config.sheets.tags import SheetUse
from gateway.engine.device.device_settings import DeviceSettings
from gateway.planning.wire_timing import WireTiming
from gateway.tags import Tag
from gateway.tags.tag import NotReal
from gateway.tags.transfer import TransferRule
from gateway.transport.modem_events import ModemSettings
from gateway.transport.port import (
    ListenAddress,
    PortAddress,
    SerialSettings,
    TcpAddress,
    TlsConfig,
)

P = TypeVar("P")


@dataclass(frozen=True, slots=True, kw_only=True)
class LineConfig:
    """One line and the devices on it."""

    name: str
    port: PortAddress
    serial: SerialSettings
    wire: WireTiming
    echo: bool | None  # the port receives its own requests; None: unknown
    serve: bool = False  # a master on the line asks, and the devices are stations of the gateway
    request_gap: float | None = None  # seconds within a request of that master; None: by the speed
    modem: ModemSettings | None = None  # with a modem at the port
    connect_delay: float = 0.0  # seconds from the connection to the first request
    close_after: str = ""  # "round": connected only while polls are due
    listen_only: bool = False  # another master owns the wire: nothing is ever sent
    not_real: NotReal | None = None  # behind the port; None: real devices
    devices: tuple[DeviceSettings, ...]

    @property
    def tags(self) -> tuple[Tag, ...]:
        return tuple(tag for device in self.devices for tag in device.tags)


@runtime_checkable
class Secured(Protocol):
    """Settings of a part with ports of TLS."""

    def secured(self) -> Mapping[str, TlsConfig | None]:
        """Returns the certificates, by setting."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """One whole file."""

    name: str
    state_file: Path | None = None  # learned properties of the devices, across restarts
    audit_file: Path | None = None  # who wrote, commanded and acknowledged what
    standby: str | None = None  # the group of an active and a standby gateway
    standby_alone: float | None = None  # seconds without a link until it becomes active
    secret_file: Path | None = None  # None: claims and tokens are not signed
    writers_file: Path | None = None  # None: every client of Zenoh may write
    folder: Path | None = None  # of the files that the gateway writes
    writers_state: Path | None = None  # with `writers_file`: what a restart must not accept again
    zenoh: ZenohConfig
    parts: Mapping[str, Any]  # the settings of parts by section; `part` finds them by their class
    lines: tuple[LineConfig, ...]
    transfers: tuple[TransferRule, ...] = ()
    watch: bool = False  # a changed file is reloaded by itself
    sheets: tuple[SheetUse, ...] = ()  # files that the tags of some devices come from
    # Of the settings in the file; empty: they are in no file.
    digest: str = field(default="", compare=False, repr=False)

    def part(self, kind: type[P]) -> P | None:
        """Returns the settings of a part; None: the file has not its section."""
        return next((one for one in self.parts.values() if isinstance(one, kind)), None)

    @cached_property
    def devices(self) -> tuple[DeviceSettings, ...]:
        return tuple(device for line in self.lines for device in line.devices)

    @property
    def secured(self) -> Mapping[str, TlsConfig]:
        """The certificates of Zenoh, of the lines and of parts, by setting."""
        ports = {f"lines.{line.name}.tls": line.port for line in self.lines}
        kinds = (TcpAddress, ListenAddress)
        found = {name: one.tls for name, one in ports.items() if isinstance(one, kinds)}
        found = {"zenoh.tls": self.zenoh.tls, **found}
        for one in self.parts.values():
            if isinstance(one, Secured):
                found |= one.secured()
        return {name: tls for name, tls in found.items() if tls is not None}

    @property
    def dialling(self) -> Mapping[str, float]:
        """Seconds that a request may wait for a telephone call or a connection, by device."""
        return {
            device.name: line.connect_delay if line.modem is None else line.modem.dial_timeout
            for line in self.lines
            if line.modem is not None or line.close_after
            for device in line.devices
        }

    @property
    def held_file(self) -> Path | None:
        """The file of the values with `retain: true`."""
        return None if self.state_file is None else self.state_file.with_suffix(".held.json")

    def without(self, devices: Container[str]) -> "Config":
        """Returns the file without some devices, and without lines that have no others."""
        lines = [
            replace(line, devices=tuple(d for d in line.devices if d.name not in devices))
            for line in self.lines
        ]
        left = (
            line
            for line, before in zip(lines, self.lines, strict=True)
            if line.devices or not before.devices
        )
        return replace(self, lines=tuple(left))
