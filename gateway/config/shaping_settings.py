"""Settings that shape a value: docs/shaping.md."""

from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PlainValidator,
    Tag,
    WithJsonSchema,
    model_validator,
)

from gateway.config import shaping_parsers as parsers
from gateway.config.setting_types import Duration
from gateway.tags.shaping import Bounds, Names
from gateway.values import Byte

_PAIR_SCHEMA: dict[str, Any] = {
    "type": "array",
    "items": {"type": "number"},
    "minItems": 2,
    "maxItems": 2,
}
_CLAMP_SCHEMA = _PAIR_SCHEMA | {"items": {"type": ["number", "null"]}}
_ENUM_SCHEMA = {
    "type": "object",
    "propertyNames": {"pattern": "^-?[0-9]+$"},
    "additionalProperties": {"type": "string"},
    "minProperties": 1,
}
_BITS_SCHEMA = {
    "type": "object",
    "propertyNames": {"pattern": "^([0-9]|1[0-5])$"},
    "additionalProperties": {"type": ["string", "object"]},
    "minProperties": 1,
}


CONFIG = ConfigDict(arbitrary_types_allowed=True, defer_build=True)
Numbered = Annotated[Names, PlainValidator(parsers.names), WithJsonSchema(_ENUM_SCHEMA)]
Pair = Annotated[tuple[float, float], PlainValidator(parsers.pair), WithJsonSchema(_PAIR_SCHEMA)]


Decimals = Annotated[int, Field(ge=0, le=15)] | None
Clamp = Annotated[Bounds | None, PlainValidator(parsers.clamp), WithJsonSchema(_CLAMP_SCHEMA)]


class CounterSection(BaseModel):
    """A counter of the device that begins again at 0; left out: as wide as its type."""

    model_config = CONFIG | ConfigDict(extra="forbid", frozen=True, strict=True)

    bits: Annotated[int, Field(ge=1, le=64)] | None = None
    """The width of the counter."""
    top: Annotated[int, Field(ge=1, le=2**63 - 1)] | None = None
    """The greatest count, such as 9999; instead of `bits`."""
    most: Annotated[int, Field(ge=1, le=2**63 - 1)] | None = None
    """The greatest step from one read to the next; more is no count. Left out: half the range."""


def _counter_shape(value: object) -> str:
    return "rule" if isinstance(value, (dict, CounterSection)) else "flag"


Counter = Annotated[
    Annotated[bool, Tag("flag")] | Annotated[CounterSection, Tag("rule")],
    Discriminator(_counter_shape),
]


class ShapingDefaults(BaseModel):
    """Settings that shape a number: for a whole file, line or device, or for one tag."""

    model_config = CONFIG

    from_: Pair | None = Field(default=None, alias="from")
    """Two values of the device, such as [4, 20]; `to` has the values of the tag there."""
    to: Pair | None = None
    """The values of the tag at the two ends of `from`, such as [0, 100]; instead of scale."""
    decimals: Decimals = None
    """A read is rounded to so many decimals, and so is a write."""
    clamp: Clamp = None
    """A read outside is shown as the nearest end, such as [0, 100] or [0, null]."""

    debounce: Duration = 0.0
    """A bit changes after it had the new value for this time; 0s: at once."""

    @model_validator(mode="after")
    def _both_ends(self) -> Self:
        if (self.from_ is None) is not (self.to is None):
            raise ValueError("from and to belong together: from: [4, 20] and to: [0, 100]")
        other = self.model_fields_set & {"scale", "offset"}
        if self.from_ is not None and other:
            raise ValueError(f"from and to replace scale and offset: remove {min(other)}")
        return self


class ShapingSettings(BaseModel):
    """Settings that shape the value of one tag."""

    model_config = CONFIG

    byte: Annotated[
        Byte | None,
        PlainValidator(parsers.byte),
        WithJsonSchema({"type": "string", "enum": ["low", "high"]}),
    ] = None
    """The byte of the word that a uint8 or int8 has; left out: the low one."""
    enum: Numbered | None = None
    """Names of the values, such as {0: off, 1: auto}; a write takes the number or the name."""
    invert: bool = False
    """The bit is shown and written the other way round."""
    bits: Annotated[
        dict[int, Any] | None, PlainValidator(parsers.bits), WithJsonSchema(_BITS_SCHEMA)
    ] = None
    """One tag for each named bit of the word, instead of the word: {0: pump, 3: fault}."""
    counter: Counter = False
    """The total of a counter that begins again at 0."""
    computed: str | None = None
    """Instead of an address: arithmetic with the names of tags, such as flow_a + flow_b."""
