"""Values of the gateway as metrics of Sparkplug B, and back."""

import math
import struct
from datetime import datetime
from typing import Any, NamedTuple

from gateway.bridges.documents import Known
from gateway.errors import BadValue

GOOD, BAD = 192, 0
INT32, INT64, UINT32, UINT64, BOOLEAN, STRING = 3, 4, 7, 8, 11, 12
_OF_ARRAY = 21  # added to the type of an element


class Type(NamedTuple):
    """A type of Sparkplug: its number, the field of its value, and its form for `struct`."""

    number: int
    field: str
    form: str = ""


TYPES = {  # by the type of a tag; the others are texts
    "int8": Type(1, "int_value", "b"),
    "int16": Type(2, "int_value", "h"),
    "int32": Type(INT32, "int_value", "i"),
    "int64": Type(INT64, "long_value", "q"),
    "uint8": Type(5, "int_value", "B"),
    "uint16": Type(6, "int_value", "H"),
    "bcd16": Type(6, "int_value", "H"),
    "uint32": Type(UINT32, "long_value", "I"),
    "bcd32": Type(UINT32, "long_value", "I"),
    "uint64": Type(UINT64, "long_value", "Q"),
    "float32": Type(9, "float_value", "f"),
    "float64": Type(10, "double_value", "d"),
    "bool": Type(BOOLEAN, "boolean_value", "?"),
}
_TEXT = Type(STRING, "string_value")
_BY_NUMBER = {own.number: own for own in TYPES.values()} | {STRING: _TEXT}
_FIELDS = (
    *("int_value", "long_value", "float_value", "double_value"),
    *("boolean_value", "string_value", "bytes_value"),
)
_SHOWN = ("reason", "origin", "limited", "text")  # besides the quality


def type_of(meta: Known) -> Type:
    """Returns the type of an element, for an array."""
    return TYPES.get(meta["type"].partition("[")[0], _TEXT)


def number_of(meta: Known) -> int:
    """Returns the number of the data type.

    A UInt32 is sent as a UInt64: programs disagree about its field, and read null or 0.
    """
    number = type_of(meta).number
    if meta.get("length"):
        return number + _OF_ARRAY
    return UINT64 if number == UINT32 else number


def milliseconds(known: Known) -> int:
    return round(datetime.fromisoformat(known["time"]).timestamp() * 1000)


def fill(metric: Any, known: Known, meta: Known) -> None:
    """Sets time, value and quality of a metric. A value that its type cannot hold is bad."""
    metric.timestamp = milliseconds(known)
    quality, about = known["quality"], {name: known.get(name) for name in _SHOWN}
    if quality == "bad":
        metric.is_null = True
    elif not _set(metric, known["value"], meta):
        metric.is_null, quality, about["reason"] = True, "bad", "type-mismatch"
    add(metric, "Quality", GOOD if quality == "good" else BAD)
    for name, text in about.items():
        if text:
            add(metric, name.capitalize(), str(text))


def add(metric: Any, name: str, value: str | float) -> None:
    """Adds a property."""
    metric.properties.keys.append(name)
    match value:
        case bool():
            metric.properties.values.add(type=BOOLEAN, boolean_value=value)
        case str():
            metric.properties.values.add(type=STRING, string_value=value)
        case int():
            metric.properties.values.add(type=INT32, int_value=value)
        case _:
            metric.properties.values.add(type=10, double_value=value)


def _set(metric: Any, value: Any, meta: Known) -> bool:
    """Returns False if the type cannot hold the value."""
    own = type_of(meta)
    if bool(meta.get("length")) != isinstance(value, list):
        return False
    values = value if isinstance(value, list) else [value]
    if own.form in ("f", "d"):
        values = [float(one) if type(one) is int else one for one in values]
    expected = {"": str, "?": bool, "f": float, "d": float}.get(own.form, int)
    if any(type(one) is not expected for one in values):
        return False
    if own is _TEXT:
        metric.string_value = value
        return True
    try:
        packed = struct.pack(f"<{len(values)}{own.form}", *values)
    except (struct.error, OverflowError):
        return False
    if isinstance(value, list):
        metric.bytes_value = _bits(values) if own.number == BOOLEAN else packed
    elif own.field in ("int_value", "long_value"):
        width = 0xFFFFFFFF if own.field == "int_value" else 0xFFFFFFFFFFFFFFFF
        setattr(metric, own.field, value & width)
    else:
        setattr(metric, own.field, values[0])
    return True


def _bits(values: list[bool]) -> bytes:
    """Returns their number, then the first value in the highest bit of the first byte."""
    octets = bytearray((len(values) + 7) // 8)
    for place, is_set in enumerate(values):
        octets[place // 8] |= is_set << 7 - place % 8
    return struct.pack("<I", len(values)) + octets


def value_of(metric: Any, meta: Known) -> Any:
    """Returns the value that a command has for a tag. Raises `BadValue`.

    A whole number is sent without its sign, in 8, 16, 32 or 64 bits: its type says what it means.
    """
    own = type_of(meta)
    if metric.is_null:
        raise BadValue("null cannot be written")
    if metric.HasField("datatype"):
        own = _BY_NUMBER.get(metric.datatype, own)
        if meta.get("length") and metric.datatype != number_of(meta):
            raise BadValue(f"the data type is {metric.datatype}, not {number_of(meta)}")
    if meta.get("length"):
        return _elements(metric.bytes_value, own if own.form else type_of(meta), meta["length"])
    fields = [field for field in _FIELDS if metric.HasField(field)]
    if len(fields) != 1:
        raise BadValue("a command has one value")
    value = getattr(metric, fields[0])
    if fields[0] in ("int_value", "long_value") and own.form in ("b", "h", "i", "q"):
        return _signed(value, struct.calcsize(own.form) * 8)
    if isinstance(value, float) and not math.isfinite(value):
        raise BadValue(f"{value} is no number")
    return value


def _signed(value: int, bits: int) -> int:
    """Programs extend the sign to 32 or 64 bits, or to the bits of the type."""
    for width in (bits, 32, 64):
        top = 1 << width
        if value < top and value >= top - (1 << bits - 1):
            return value - top
    if value < 1 << bits - 1:
        return value
    raise BadValue(f"{value} is too large for its type")


def _elements(data: bytes, own: Type, length: int) -> list[Any]:
    try:
        if own.number == BOOLEAN:
            [count] = struct.unpack_from("<I", data)
            if count != length or len(data) != 4 + (length + 7) // 8:
                raise BadValue(f"{count} values in {len(data)} bytes, not {length}")
            return [bool(data[4 + n // 8] & 0x80 >> n % 8) for n in range(length)]
        values = list(struct.unpack(f"<{length}{own.form}", data))
    except struct.error:
        raise BadValue(f"{len(data)} bytes are not {length} values of this type") from None
    if own.form in ("f", "d") and not all(map(math.isfinite, values)):
        raise BadValue("an element is no number")
    return values
