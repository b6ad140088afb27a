"""How one setting looks to pydantic and to an editor: durations, names, files, endpoints."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PlainValidator, WithJsonSchema

from gateway.config import written
from gateway.values import Kind, Order

DURATION_SCHEMA: dict[str, Any] = {
    "type": "string",
    "pattern": r"^[0-9]+(\.[0-9]+)? ?(ms|s|min|h|d)$",
    "examples": ["500ms", "2s", "15min", "1h", "7d"],
}
# `40101` as an address and `7E1` as a format look like numbers to an editor.
TEXT_SCHEMA = {"type": ["string", "number"]}
FORMAT_SCHEMA = {
    "anyOf": [
        {"type": "string", "enum": [f"{d}{p}{s}" for d in "78" for p in "NEO" for s in "12"]},
        {"type": "number", "enum": [70, 700, 80, 800]},
    ]
}
_KINDS = [kind.value for kind in Kind if kind is not Kind.STRING]
TYPE_SCHEMA = {
    "anyOf": [
        {"type": "string", "enum": _KINDS},
        {"type": "string", "pattern": r"^string\[[0-9]+\]$"},
    ]
}
DEADBAND_SCHEMA = {
    "anyOf": [
        {"type": "number", "minimum": 0},
        {"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)? ?%$"},
    ]
}
_ENDPOINT_SCHEMA = {"type": "string", "examples": ["tcp/127.0.0.1:7447"]}
_ORDER_SCHEMA = {"type": "string", "enum": [order.value for order in Order]}
PORT_SCHEMA = {
    "type": "string",
    "examples": ["/dev/ttyUSB0", "COM3", "tcp://10.0.0.7:4001", "rfc2217://host:port", "simulator"],
}

Duration = Annotated[float, PlainValidator(written.duration), WithJsonSchema(DURATION_SCHEMA)]
Interval = Annotated[float, PlainValidator(written.interval), WithJsonSchema(DURATION_SCHEMA)]
Text = Annotated[str, Field(strict=True), WithJsonSchema(TEXT_SCHEMA)]
Name = Annotated[str, PlainValidator(written.name), WithJsonSchema(TEXT_SCHEMA)]
FilePath = Annotated[Path, PlainValidator(written.path), WithJsonSchema({"type": "string"})]
OrderName = Annotated[Order, PlainValidator(written.order), WithJsonSchema(_ORDER_SCHEMA)]
Endpoint = Annotated[str, PlainValidator(written.endpoint), WithJsonSchema(_ENDPOINT_SCHEMA)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
