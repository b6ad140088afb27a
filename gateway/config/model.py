"""The sections of the file as pydantic sees them: name, type and meaning of every setting.

An editor shows the descriptions. Mistakes that need more than one setting (an address that the
device does not have, two stations with one number) are found by `gateway.config.build`.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)
from pydantic import Tag as Choice

from gateway.config import parsers, tag_parsers
from gateway.config.alarm_rules import check_alarm
from gateway.config.modem_settings import ModemSection
from gateway.config.session_model import GatewaySection, Section, ZenohSection
from gateway.config.setting_types import (
    DEADBAND_SCHEMA,
    FORMAT_SCHEMA,
    SCALE_SCHEMA,
    TYPE_SCHEMA,
    Baudrate,
    Distance,
    Duration,
    FilePath,
    Finite,
    HostName,
    Interval,
    OrderName,
    Port,
    Text,
    WebAddress,
)
from gateway.config.shaping_settings import Clamp, Decimals, ShapingDefaults, ShapingSettings
from gateway.tags import Deadband, Form, Publish
from gateway.values import Order, ValueType


class WritersSection(Section):
    """The clients that may write, by their secrets."""

    file: FilePath
    """One line `name:secret` for each client; see docs/security.md."""


class HistorySection(Section):
    """Samples kept on disk, for tags with `history: true`."""

    path: FilePath = Path("history.db")
    """The SQLite file, relative to $STATE_DIRECTORY, else to this file's folder."""
    keep: Interval = 7 * 86400.0
    """Older samples are deleted."""
    max_size: Annotated[
        int,
        PlainValidator(parsers.size),
        WithJsonSchema({"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)? ?([kKMGT]B)$"}),
    ] = 10**9
    """The oldest samples are deleted when the file grows beyond this size."""


class AlarmsSection(Section):
    """The alarms of the gateway."""

    path: FilePath | None = None
    """Keeps alarms across restarts; left out: alarms.json in $STATE_DIRECTORY, or beside this file
    if a tag has an alarm."""
    devices: bool = True
    """A device that does not reply is an alarm."""
    lines: bool = True
    """A line that is down is an alarm."""
    transfers: bool = True
    """A transfer that does not work is an alarm."""


class WebSection(Section):
    """The status page and /metrics."""

    listen: WebAddress = ("127.0.0.1", 8080)
    """The address of the page."""
    tokens_file: FilePath | None = None
    """One line `name:token` for each client; without it nothing can be written."""
    names: list[HostName] = []
    """Names of this machine in a browser's address, besides `localhost` and its host name."""


class WriteSection(Section):
    """The rules for writing a tag."""

    min: Finite | None = None
    """The least value, in the unit of the tag."""
    max: Finite | None = None
    """The greatest value, in the unit of the tag."""
    verify: bool = False
    """Read back after the acknowledgement and compare."""
    repeat: bool = False
    """Send the write again after an unclear result."""
    latest: bool = False
    """Of several waiting writes, send only the last."""

    @model_validator(mode="after")
    def _order(self) -> Self:
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:.15g} is above max {self.max:.15g}")
        return self


class AlarmSection(Section):
    """The alarm of a number or a bit: docs/alarms.md."""

    high_high: Finite | None = None
    """A value from here on is in alarm, of the worse level."""
    high: Finite | None = None
    """A value from here on is in alarm."""
    low: Finite | None = None
    """A value from here downwards is in alarm."""
    low_low: Finite | None = None
    """A value from here downwards is in alarm, of the worse level."""
    on: bool = False
    """A bit is in alarm while it is on."""
    off: bool = False
    """A bit is in alarm while it is off."""
    hysteresis: Distance = 0.0
    """A limit is left when the value is so far from it, in the unit of the tag."""
    delay: Duration = 0.0
    """A limit counts when it is reached for so long."""
    text: Text = ""
    """A sentence for people; left out: the description of the tag."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        check_alarm({name: getattr(self, name) for name in type(self).model_fields})
        return self


Band = Annotated[
    Deadband | None, PlainValidator(tag_parsers.deadband), WithJsonSchema(DEADBAND_SCHEMA)
]
Payload = Annotated[
    Form,
    PlainValidator(tag_parsers.form),
    WithJsonSchema({"type": "string", "enum": ["json", "raw"]}),
]


def _write_shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, WriteSection)) else "flag"


class TagDefaults(Section, ShapingDefaults):
    """Tag settings for a whole file, line or device."""

    type: Annotated[
        ValueType | None, PlainValidator(parsers.value_type), WithJsonSchema(TYPE_SCHEMA)
    ] = None
    """The type of the value, or of the elements of an array such as uint16[50]; left out: bool for
    a bit, a whole number otherwise."""
    every: Interval = 1.0
    """The interval of reading."""
    scale: Annotated[Finite, AfterValidator(parsers.scale), WithJsonSchema(SCALE_SCHEMA)] = 1.0
    """value = raw x scale + offset"""
    offset: Finite = 0.0
    """value = raw x scale + offset"""
    unit: Text = ""
    """The unit of the value, for people: rpm, °C."""
    description: Text = ""
    """A description, for people."""
    deadband: Band = None
    """A smaller change is not published: 0.5 (in the tag's unit) or 2%."""
    word_order: OrderName = Order.LOW_FIRST
    """The word of a 32- or 64-bit value at the lower address."""
    byte_order: OrderName | None = None
    """The byte of each word that comes first."""
    publish: Annotated[
        Publish,
        PlainValidator(tag_parsers.publish),
        WithJsonSchema({"type": "string", "enum": ["change", "always"]}),
    ] = Publish.CHANGE
    """Publish when the value changes, or every value that is read."""
    heartbeat: Interval | None = None
    """Publish at least this often, changed or not."""
    history: bool = False
    """Store the values on disk."""
    payload: Payload = Form.JSON
    """json: value, quality and time; raw: the bare value as text."""
    write: Annotated[
        Annotated[bool, Choice("flag")] | Annotated[WriteSection, Choice("rule")],
        Discriminator(_write_shape),
    ] = False
    """Permission to write the tag, with its rules."""
    hold_last: bool = False
    """On a served line: answer the master with the last good value instead of an error."""


class ComputedSection(Section):
    """A value that is calculated from the values of other tags."""

    computed: Text
    """Arithmetic with the names of tags, such as flow_a + flow_b."""
    unit: Text = ""
    """The unit of the value, for people."""
    description: Text = ""
    """A description, for people."""
    decimals: Decimals = None
    """The value is rounded to so many decimals."""
    clamp: Clamp = None
    """A value outside is shown as the nearest end."""
    deadband: Band = None
    """A smaller change is not published."""
    history: bool = False
    """Store the values on disk."""
    payload: Payload = Form.JSON
    """json: value, quality and time; raw: the bare value as text."""
    alarm: AlarmSection | None = None
    """Raise an alarm at a limit of the value."""


class TagSection(TagDefaults, ShapingSettings):
    """One value of a device."""

    address: Text
    """As the maker writes it: D100, X17, D7.3, holding:100; for frames the name of a field."""
    event: bool = False
    """Publish every frame, even with the same value as the last: a bar code."""
    alarm: AlarmSection | None = None
    """Raise an alarm at a limit of the value, or while a bit is on."""
    source: Text | None = None
    """On a served line: the tag, as device/tag, whose value the master reads here."""
    retain: bool = False
    """On a served line: keep the value that clients wrote across restarts."""


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
    blocks: Annotated[
        bool | Literal["only"],
        PlainValidator(parsers.blocks),
        WithJsonSchema({"enum": [True, False, "only"]}),
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
    """A sheet with more tags of the device, CSV or .xlsx: docs/import.md."""


class LineSection(Section):
    """One line and the devices on it."""

    port: Port
    """A serial port, tcp://host:port, rfc2217://host:port, modem:<one of these>, or simulator."""
    baudrate: Baudrate = None
    """Speed of the line, also behind a device server; left out: the default of the protocol."""
    format: Annotated[
        str | None, PlainValidator(parsers.serial_format), WithJsonSchema(FORMAT_SCHEMA)
    ] = None
    """Data bits, parity, stop bits: 7E1, 8N1; left out: the default of the protocol."""
    echo: bool | None = None
    """true: the port receives its own requests, as with some two-wire RS-485 converters."""
    serve: bool = False
    """true: the devices are stations of this gateway, and a master on the line asks them."""
    request_gap: Duration | None = None
    """With serve: the longest pause within a request; left out: by the speed, 2 s with a modem."""
    listen_only: bool = False
    """true: learns the values from another master's traffic, and sends nothing, ever."""
    modem: ModemSection | None = None
    """The modem of a port `modem:…`, and its calls: docs/modem.md."""
    defaults: dict[str, Any] = {}
    devices: dict[str, Any]
    """The devices on this line, by name."""


class FileSection(Section):
    """A gateway between PLCs and Zenoh."""

    gateway: GatewaySection = GatewaySection()
    zenoh: ZenohSection = ZenohSection()
    writers: WritersSection | None = None
    history: HistorySection | None = None
    web: WebSection | None = None
    alarms: AlarmsSection = AlarmsSection()
    templates: dict[str, Any] = {}
    """Devices with parameters, which devices `use`: docs/templates.md."""
    templates_from: str | list[str] = []
    """Files with more templates."""
    defaults: dict[str, Any] = {}
    lines: dict[str, Any]
    """The lines, by name."""
    transfers: list[Any] = []
    """Values that the gateway reads from one PLC and writes to another: docs/transfers.md."""
