"""The settings of the Zenoh session, as plain data, with the files that they name."""

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path as FilePath

from gateway.config.messages import Mistakes
from gateway.errors import ConfigError
from gateway.files import is_file
from gateway.transport.port import TlsConfig as TlsConfig

NAME = "gateway"  # of a gateway without one in the file
LISTEN = ("tcp/127.0.0.1:7447",)  # where the file says nothing


class ZenohMode(StrEnum):
    PEER = "peer"
    CLIENT = "client"
    ROUTER = "router"


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
    config_file: FilePath | None = None
    tls: TlsConfig | None = None
    user: str | None = None  # of this gateway, where it connects to
    password_file: FilePath | None = None
    users_file: FilePath | None = None  # for those who connect: a line `user:password` each
    refresh: float = 600.0  # seconds in which every value is published at least once

    def check(self) -> None:
        """Raises `ConfigError` for settings that do not go together."""
        if self.password_file is not None and self.user is None:
            raise ConfigError("password_file has no effect without user")


def with_files(found: ZenohConfig, folder: FilePath, mistakes: Mistakes) -> ZenohConfig:
    """Returns the session with its paths below `folder`; notes each file that is not there."""

    def file(setting: str) -> FilePath | None:
        return existing_file(getattr(found, setting), folder, mistakes.at(setting))

    tls = found.tls
    return replace(
        found,
        config_file=file("config_file"),
        tls=None if tls is None else tls_files(tls, folder, mistakes.at("tls")),
        password_file=file("password_file"),
        users_file=file("users_file"),
    )


def tls_files(found: TlsConfig, folder: FilePath, mistakes: Mistakes) -> TlsConfig:
    """Returns the certificates with their paths below `folder`; notes files that are not there."""

    def file(name: str) -> FilePath | None:
        return existing_file(getattr(found, name), folder, mistakes.at(name))

    return replace(
        found,
        ca=file("ca"),
        certificate=file("certificate"),
        key=file("key"),
        revoked=file("revoked"),
    )


def existing_file(name: FilePath | None, folder: FilePath, mistakes: Mistakes) -> FilePath | None:
    """Returns the path of a file that must exist, if this is its machine."""
    if name is None:
        return None
    file = folder / name
    if not (mistakes.elsewhere or is_file(file)):
        mistakes.add(f"there is no file {file}")
    return file
