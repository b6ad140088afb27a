"""The settings of one row of `transfers:`: docs/transfers.md."""

from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, WithJsonSchema, model_validator

from gateway.config.messages import shown
from gateway.config.settings import parsers
from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import SCALE_SCHEMA, Finite, Interval, Parsed, Text
from gateway.errors import ConfigError
from gateway.values import Value

_IF_STALE_SCHEMA: dict[str, Any] = {
    "anyOf": [
        {"type": "string", "enum": ["skip"]},
        {
            "type": "object",
            "properties": {"write": {"type": ["number", "boolean", "string", "array"]}},
            "required": ["write"],
            "additionalProperties": False,
        },
    ]
}


def _if_stale(value: object) -> Value | None:
    """Returns the value to write; None: nothing is written."""
    if value is None or value == "skip":
        return None
    match value:
        case {"write": bool() | int() | float() | str() as known, **rest} if not rest:
            return known
        case {"write": list() as values, **rest} if not rest and all(map(_is_scalar, values)):
            return tuple(values)
    raise ConfigError(f"{shown(value)}: write skip, or {{write: 0}} with the value to write")


def _is_scalar(value: object) -> bool:
    return isinstance(value, (bool, int, float, str))


class TransferSection(Section):
    """A value that the gateway reads from one PLC and writes to another: docs/transfers.md."""

    from_: Annotated[Text, Field(alias="from")]
    """The tag that is read, as device/tag, or a range such as mixer:D10..D19."""
    to: Text
    """The tag that is written, as device/tag, or a range such as plc:D0..D9."""
    on: Literal["change"] | None = None
    """change: each new value is carried once; this is the default."""
    every: Interval | None = None
    """The present value is carried at this interval, changed or not; instead of `on`."""
    scale: Annotated[Finite, AfterValidator(parsers.scale), WithJsonSchema(SCALE_SCHEMA)] = 1.0
    """carried value = value of the source x scale + offset"""
    offset: Finite = 0.0
    """carried value = value of the source x scale + offset"""
    stale: Interval | None = None
    """A value whose last read is older is not carried; left out: 5s, or three intervals of it."""
    if_stale: Annotated[Value | None, Parsed(_if_stale, _IF_STALE_SCHEMA)] = None
    """The source is too old: skip writes nothing, {write: 0} writes this value once."""

    @model_validator(mode="after")
    def _one_time(self) -> Self:
        if self.on is not None and self.every is not None:
            raise ValueError("on: change and every exclude each other: remove one of them")
        return self
