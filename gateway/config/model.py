"""The sections of the file as pydantic sees them: name, type and meaning of every setting.

The descriptions are what an editor shows. What one setting alone cannot tell (an address its
device does not have, two stations of one number) is found in `gateway.config.build`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)
from pydantic import Tag as Choice

from gateway.config import parsers
from gateway.config.setting_types import (
    DEADBAND_SCHEMA,
    FORMAT_SCHEMA,
    SCALE_SCHEMA,
    TYPE_SCHEMA,
    Baudrate,
    Duration,
    Endpoint,
    Endpoints,
    FilePath,
    Finite,
    Group,
    Interval,
    Name,
    OrderName,
    Port,
    Prefix,
    Text,
    WebAddress,
)
from gateway.tags import Deadband, Form, Publish
from gateway.values import Order, ValueType


class Section(BaseModel):
    """Settings of one kind; a setting that is not listed is a mistake."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        arbitrary_types_allowed=True,
        use_attribute_docstrings=True,
    )


class GatewaySection(Section):
    """This gateway."""

    name: Name = "gateway"
    """This gateway's own chunk in the key space."""
    state: FilePath | None = None
    """A file for what was learned of the devices (refused addresses), kept across restarts."""
    standby: Group | None = None
    """A name shared by two gateways of one plant: one serves, the other stands by."""
    standby_alone: Interval | None = None
    """Go on the wire after so long without any Zenoh link; left out: wait for the network."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        if self.standby_alone is not None and self.standby is None:
            raise ValueError("standby_alone means nothing without standby")
        return self


class TlsSection(Section):
    """Certificates, as PEM files."""

    ca: FilePath | None = None
    """Whose certificates are believed."""
    certificate: FilePath | None = None
    """This gateway's own."""
    key: FilePath | None = None
    """The private key of the certificate; closed to other users of this machine."""
    mutual: bool = False
    """Both sides show a certificate: who has none cannot connect."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        if (self.certificate is None) is not (self.key is None):
            raise ValueError("certificate and key belong together")
        if self.mutual and (self.ca is None or self.certificate is None):
            raise ValueError("mutual needs ca, certificate and key")
        return self


class ZenohSection(Section):
    """How to join the Zenoh network."""

    prefix: Prefix = "plant"
    """Every key starts with it."""
    mode: Literal["peer", "client", "router"] = "peer"
    """How this session takes part in the network."""
    listen: Endpoints = ["tcp/127.0.0.1:7447"]
    """Endpoints to listen at; loopback unless you say otherwise."""
    connect: list[Endpoint] = []
    """Endpoints to connect to."""
    config_file: FilePath | None = None
    """A Zenoh JSON5 file for everything else, laid under these settings."""
    tls: TlsSection | None = None
    """For endpoints that begin with tls/ or quic/."""
    user: str | None = None
    """Our own name where we connect to."""
    password_file: FilePath | None = None
    """Its first line is our password; without it: the variable PLC_GATEWAY_ZENOH_PASSWORD."""
    users_file: FilePath | None = None
    """Who may connect to us: a line `user:password` each, as Zenoh has it."""

    @model_validator(mode="after")
    def _with_user(self) -> Self:
        if self.password_file is not None and self.user is None:
            raise ValueError("password_file means nothing without user")
        return self


class WritersSection(Section):
    """Who may write, by tokens."""

    file: FilePath
    """A line `name:salt:hash` each; see docs/security.md."""


class HistorySection(Section):
    """Samples kept on disk, for tags with `history: true`."""

    path: FilePath = Path("history.db")
    """The SQLite file, relative to this file's folder."""
    keep: Interval = 7 * 86400.0
    """Older samples are deleted."""
    max_size: Annotated[
        int,
        PlainValidator(parsers.size),
        WithJsonSchema({"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)? ?([kKMGT]B)$"}),
    ] = 10**9
    """The oldest samples are deleted when the file grows beyond it."""


class WebSection(Section):
    """The status page and /metrics."""

    listen: WebAddress = ("127.0.0.1", 8080)
    """Where the page is served."""


class WriteSection(Section):
    """What may be written, and how."""

    min: Finite | None = None
    """The least value, in the tag's own unit."""
    max: Finite | None = None
    """The greatest value, in the tag's own unit."""
    verify: bool = False
    """Read back after the acknowledgement and compare."""
    repeat: bool = False
    """May be sent again when nobody knows whether it was done."""
    latest: bool = False
    """Of several waiting writes only the last is sent."""

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:.15g} is above max {self.max:.15g}")
        return self


def _write_shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, WriteSection)) else "flag"


class TagDefaults(Section):
    """Tag settings for a whole file, line or device."""

    type: Annotated[
        ValueType | None, PlainValidator(parsers.value_type), WithJsonSchema(TYPE_SCHEMA)
    ] = None
    """What the words mean; left out: bool for a bit, a whole number otherwise."""
    every: Interval = 1.0
    """How often the tag is read."""
    scale: Annotated[Finite, AfterValidator(parsers.scale), WithJsonSchema(SCALE_SCHEMA)] = 1.0
    """value = raw x scale + offset"""
    offset: Finite = 0.0
    """value = raw x scale + offset"""
    unit: Text = ""
    """The unit of the value, for people: rpm, °C."""
    description: Text = ""
    """What it is, for people."""
    deadband: Annotated[
        Deadband | None, PlainValidator(parsers.deadband), WithJsonSchema(DEADBAND_SCHEMA)
    ] = None
    """A smaller change is not published: 0.5 (in the tag's unit) or 2%."""
    word_order: OrderName = Order.LOW_FIRST
    """Which word of a 32- or 64-bit value has the lower address."""
    byte_order: OrderName | None = None
    """Which byte of each word comes first."""
    publish: Annotated[
        Publish,
        PlainValidator(parsers.publish),
        WithJsonSchema({"type": "string", "enum": ["change", "always"]}),
    ] = Publish.CHANGE
    """Publish when the value changes, or every value that is read."""
    heartbeat: Interval | None = None
    """Publish at least so often, changed or not."""
    history: bool = False
    """Keep the values on disk."""
    payload: Annotated[
        Form,
        PlainValidator(parsers.form),
        WithJsonSchema({"type": "string", "enum": ["json", "raw"]}),
    ] = Form.JSON
    """json: value, quality and time; raw: the bare value as text."""
    write: Annotated[
        Annotated[bool, Choice("flag")] | Annotated[WriteSection, Choice("rule")],
        Discriminator(_write_shape),
    ] = False
    """Whether and how it may be written."""


class TagSection(TagDefaults):
    """One value of a device."""

    address: Text
    """As the maker writes it: D100, X17, D7.3, holding:100; of frames the name of a field."""
    event: bool = False
    """Every frame counts, also one that says the same as the last: a bar code."""


class DeviceSection(Section):
    """A device's settings that do not depend on its protocol."""

    reply_timeout: Interval | None = None
    """How long it may take to answer, beyond the characters' own time on the wire."""
    turnaround: Duration | None = None
    """What it usually takes to answer; measured when left out."""
    silence: Duration | None = None
    """Quiet kept on the wire before it is spoken to."""
    retries: Annotated[int, Field(ge=0, le=10)] | None = None
    """How often a read that went wrong is asked again; writes never are."""
    verify_reads: Annotated[int, Field(ge=1, le=3)] = 1
    """How many readings in a row must agree before a value is believed."""
    late_guard: Duration | None = None
    """How long a late reply is waited for before anyone speaks again."""
    blocks: Annotated[
        bool | Literal["only"],
        PlainValidator(parsers.blocks),
        WithJsonSchema({"enum": [True, False, "only"]}),
    ] = False
    """One put per scan with all changed tags, at <device>/@block: also, or only that."""
    control: bool = False
    """The device may be told to run, to stop and the like."""
    enabled: bool = True
    """false: the device stays in the file but is not spoken to."""
    defaults: dict[str, Any] = {}
    tags: dict[str, Any] = {}
    """What is read, by name."""


class LineSection(Section):
    """One wire and the devices on it."""

    port: Port
    """A serial port, tcp://host:port, rfc2217://host:port, or simulator."""
    baudrate: Baudrate = None
    """Of the wire, also of the one behind a device server; the protocol's custom if left out."""
    format: Annotated[
        str | None, PlainValidator(parsers.serial_format), WithJsonSchema(FORMAT_SCHEMA)
    ] = None
    """Data bits, parity, stop bits: 7E1, 8N1; the protocol's custom if left out."""
    echo: bool | None = None
    """true: the port hears what it says itself, as some two-wire RS-485 converters do."""
    defaults: dict[str, Any] = {}
    devices: dict[str, Any]
    """The stations on this wire, by name."""


class FileSection(Section):
    """A gateway between PLCs and Zenoh."""

    gateway: GatewaySection = GatewaySection()
    zenoh: ZenohSection = ZenohSection()
    writers: WritersSection | None = None
    history: HistorySection | None = None
    web: WebSection | None = None
    defaults: dict[str, Any] = {}
    lines: dict[str, Any]
    """The wires, by name."""
