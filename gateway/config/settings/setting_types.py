"""Types of single settings for pydantic and for editors: durations, names, files, endpoints."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, WithJsonSchema, WrapValidator
from pydantic_core.core_schema import CoreSchema, no_info_plain_validator_function

from gateway.config.messages import one_of, shown
from gateway.config.settings import parsers
from gateway.errors import ConfigError
from gateway.transport.port import PortAddress
from gateway.values import NO_ELEMENTS, Kind, Order


@dataclass(frozen=True, slots=True, eq=False)
class Parsed:
    """A setting with a parser of its own. `schema`: what an editor accepts."""

    parse: Callable[[Any], object]
    schema: dict[str, Any]

    def __get_pydantic_core_schema__(self, _kind: Any, _handler: Any) -> CoreSchema:
        return no_info_plain_validator_function(self.parse)

    def __get_pydantic_json_schema__(self, _core: Any, _handler: Any) -> dict[str, Any]:
        return dict(self.schema)


def member(kind: type[StrEnum], wrong: str = "is not known") -> Parsed:
    """Returns the setting that is a member of an enumeration."""

    def parse(text: object) -> StrEnum:
        if text not in list(kind):
            raise ConfigError(f"{shown(text)} {wrong}: use {one_of(kind)}")
        return kind(str(text))

    return Parsed(parse, {"type": "string", "enum": [one.value for one in kind]})


DURATION_SCHEMA: dict[str, Any] = {
    "type": "string",
    "pattern": r"^([0-9]+(\.[0-9]+)? ?(w|d|h|min|m|s|ms|us) ?)+$",
    "examples": ["500ms", "2s", "15min", "1h30m", "7d"],
}
INTERVAL_SCHEMA = DURATION_SCHEMA | {
    "pattern": r"^(?=.*[1-9])([0-9]+(\.[0-9]+)? ?(w|d|h|min|m|s|ms|us) ?)+$"
}
# To an editor `40101` as an address and `true` as a unit are a number and a boolean.
TEXT_SCHEMA: dict[str, Any] = {"type": ["string", "number", "boolean"]}
# Letters and digits of any script: the pattern excludes the other characters of ASCII.
_NAME = r"[^\x00-,/:-@\[-\^`{-\x7f\s]+"
NAME_PATTERN, TAG_NAME_PATTERN = f"^{_NAME}$", f"^{_NAME}(/{_NAME})*$"
_CHUNK = r"[^/@*$?#][^/*$?#]*"
FORMAT_SCHEMA = {
    "anyOf": [
        {"type": "string", "enum": [f"{d}{p}{s}" for d in "78" for p in "NEO" for s in "12"]},
        {"type": "number", "enum": [70, 700, 80, 800]},
    ]
}
_KINDS = [kind.value for kind in Kind if kind is not Kind.STRING]
_ARRAYS = "|".join(kind for kind in _KINDS if kind not in NO_ELEMENTS)
TYPE_SCHEMA = {
    "anyOf": [
        {"type": "string", "enum": _KINDS},
        {"type": "string", "pattern": r"^string\[0*([1-9][0-9]?|1[0-9]{2}|2[0-4][0-9]|250)\]$"},
        {"type": "string", "pattern": rf"^({_ARRAYS})\[0*([1-9][0-9]{{0,2}}|1[0-9]{{3}}|2000)\]$"},
    ]
}
SENT_BYTES_SCHEMA = {"type": "string", "minLength": 1, "examples": ["DTU-0042", "ping<CR><LF>"]}
NETWORKS_SCHEMA = {
    "anyOf": [
        {"type": "string"},
        {"type": "array", "items": {"type": "string"}, "minItems": 1},
    ],
    "examples": [["10.1.0.0/16", "192.0.2.7"]],
}
IDENTITY_SCHEMA = {"type": "object", "additionalProperties": {"type": "string"}, "minProperties": 1}
SCALE_SCHEMA = {"type": "number", "not": {"const": 0}}
_ENDPOINT_SCHEMA = {
    "type": "string",
    "pattern": r"^[a-z][a-z0-9_-]*/[^\s/]\S*$",
    "examples": ["tcp/127.0.0.1:7447"],
}
_HOST = r"(\[[0-9A-Fa-f:.%]+\]|[^\[\]/:\s]+)"
_PORT_SCHEMA = {
    "type": "string",
    # A network port, or a path: no other scheme, and no `host:port` without a scheme.
    "pattern": rf"^((tcp|tls|udp|rfc2217|listen)://{_HOST}:[0-9]{{1,5}}"
    r"|(?![A-Za-z][A-Za-z0-9+.-]+://|([^/\\:\s]+:)?[0-9]+$)\S(.*\S)?)$",
    "examples": [
        "/dev/ttyUSB0",
        "tcp://10.0.0.7:4001",
        "tls://10.0.0.7:802",
        "udp://host:port",
        "rfc2217://host:port",
        "listen://0.0.0.0:5020",
        "modem:/dev/ttyS0",
        "simulator",
    ],
}

Duration = Annotated[float, Parsed(parsers.duration, DURATION_SCHEMA)]
Interval = Annotated[float, Parsed(parsers.interval, INTERVAL_SCHEMA)]
Text = Annotated[str, Field(strict=True), WithJsonSchema(TEXT_SCHEMA)]
Unit = Annotated[str, Parsed(parsers.unit, TEXT_SCHEMA)]
Name = Annotated[str, Parsed(parsers.name, TEXT_SCHEMA | {"pattern": NAME_PATTERN})]
Group = Annotated[str, Parsed(parsers.name, {"type": "string", "pattern": NAME_PATTERN})]
Prefix = Annotated[
    str, Parsed(parsers.prefix, TEXT_SCHEMA | {"pattern": f"^{_CHUNK}(/{_CHUNK})*$"})
]
Port = Annotated[PortAddress, Parsed(parsers.port, _PORT_SCHEMA)]
Baudrate = Annotated[
    int | None, Parsed(parsers.baudrate, {"type": "integer", "enum": list(parsers.BAUDRATES)})
]
WebAddress = Annotated[
    tuple[str, int],
    Parsed(parsers.web_address, {"type": "string", "pattern": f"^{_HOST}:[0-9]{{1,5}}$"}),
]
WebOrigin = Annotated[
    str, Parsed(parsers.origin, {"type": "string", "pattern": r"^https?://[^/\s*]+$"})
]
HostName = Annotated[
    str,
    Parsed(
        parsers.host_name,
        {"type": "string", "pattern": r"^[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?$"},
    ),
]
FilePath = Annotated[Path, Parsed(parsers.path, {"type": "string"})]
OrderName = Annotated[Order, member(Order, "is no order")]
Endpoint = Annotated[str, Parsed(parsers.endpoint, _ENDPOINT_SCHEMA)]
Endpoints = Annotated[list[Endpoint], AfterValidator(parsers.once)]
Distance = Annotated[
    float,
    WrapValidator(parsers.every_digit),
    AfterValidator(parsers.not_negative),
    WithJsonSchema({"type": "number", "minimum": 0}),
]
Finite = Annotated[float, Field(allow_inf_nan=False), WrapValidator(parsers.every_digit)]
