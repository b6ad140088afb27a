"""The settings of the Zenoh session, as plain data."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from gateway.errors import ConfigError

NAME = "gateway"  # of a gateway without one in the file
LISTEN = ("tcp/127.0.0.1:7447",)  # where the file says nothing


class ZenohMode(StrEnum):
    PEER = "peer"
    CLIENT = "client"
    ROUTER = "router"


@dataclass(frozen=True, slots=True, kw_only=True)
class TlsConfig:
    """Certificates (PEM files). `mutual`: both sides show one."""

    ca: Path | None = None  # certificate authority to trust
    certificate: Path | None = None
    key: Path | None = None
    mutual: bool = False

    def check(self) -> None:
        """Raises `ConfigError` for settings that do not go together."""
        if (self.certificate is None) is not (self.key is None):
            raise ConfigError("certificate and key belong together")
        if self.mutual and (self.ca is None or self.certificate is None):
            raise ConfigError("mutual needs ca, certificate and key")


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
    refresh: float = 600.0  # seconds in which every value is published at least once

    def check(self) -> None:
        """Raises `ConfigError` for settings that do not go together."""
        if self.password_file is not None and self.user is None:
            raise ConfigError("password_file has no effect without user")
