"""The settings of the Zenoh session, as plain data."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path


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
