"""The sections `gateway` and `zenoh`: all that a client needs to reach its gateway."""

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, model_validator

from gateway.config.settings.setting_types import (
    Endpoint,
    Endpoints,
    FilePath,
    Group,
    Interval,
    Name,
    Prefix,
)
from gateway.config.settings.zenoh_records import LISTEN, NAME, TlsConfig, ZenohConfig, ZenohMode


class Section(BaseModel):
    """Settings of one kind; any other setting is a mistake."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, arbitrary_types_allowed=True, defer_build=True
    )


class GatewaySection(Section):
    """This gateway."""

    name: Name = NAME
    """The chunk of this gateway in the keys."""
    state: FilePath | None = None
    """Keeps refused addresses across restarts; with $STATE_DIRECTORY left out: state.json there."""
    audit: FilePath | None = None
    """The audit of writes, commands and acknowledgements; with $STATE_DIRECTORY left out:
    audit.jsonl there."""
    standby: Group | None = None
    """A name shared by two gateways of one plant: one is active, the other is the standby."""
    standby_alone: Interval | None = None
    """Become active after this time without any Zenoh link; left out: wait for the network."""
    watch_config: bool = False
    """Reload this file, and the sheets that it names, one second after a change."""
    secret_file: FilePath | None = None
    """The file whose first line, the same for all gateways of a plant, signs claims and tokens."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.standby_alone is not None and self.standby is None:
            raise ValueError("standby_alone has no effect without standby")
        return self


class TlsSection(Section):
    """Certificates, as PEM files."""

    ca: FilePath | None = None
    """The certificate authority to trust."""
    certificate: FilePath | None = None
    """The certificate of this gateway."""
    key: FilePath | None = None
    """The private key of the certificate; not readable by other users of this machine."""
    mutual: bool = False
    """Both sides show a certificate: a client without one cannot connect."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        self.record().check()
        return self

    def record(self) -> TlsConfig:
        """Returns the settings as plain data; paths as in the file."""
        return TlsConfig(**dict(self))


class ZenohSection(Section):
    """The Zenoh session."""

    prefix: Prefix = "plant"
    """The beginning of every key."""
    mode: Literal["peer", "client", "router"] = "peer"
    """The role of this session in the network."""
    listen: Endpoints = list(LISTEN)
    """Endpoints to listen on; by default only this machine can connect."""
    connect: list[Endpoint] = []
    """Endpoints to connect to."""
    config_file: FilePath | None = None
    """A Zenoh JSON5 file for all other settings; the settings here replace its own."""
    tls: TlsSection | None = None
    """Certificates for endpoints that begin with tls/ or quic/."""
    user: str | None = None
    """The user name of this gateway where it connects."""
    password_file: FilePath | None = None
    """Its first line is the password; left out: the variable PLC_GATEWAY_ZENOH_PASSWORD."""
    users_file: FilePath | None = None
    """The users that may connect to this gateway: one line `user:password` each."""
    refresh: Interval = 600.0
    """Every value is published at least this often: the longest time that a lost one can cost."""

    @model_validator(mode="after")
    def _with_user(self) -> Self:
        self.record().check()
        return self

    def record(self) -> ZenohConfig:
        """Returns the settings as plain data; paths as in the file."""
        tls = None if self.tls is None else self.tls.record()
        lists = {"listen": tuple(self.listen), "connect": tuple(self.connect)}
        return ZenohConfig(**{**dict(self), **lists, "mode": ZenohMode(self.mode), "tls": tls})
