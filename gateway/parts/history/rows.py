"""Samples <-> rows of the file, without any change of value or type.

The columns are readable with any SQLite tool: `value` is the number or text itself, `kind` marks
types that SQLite lacks (see `Kind`), `bad` is NULL for a good sample and otherwise the reason.
"""

import math
from enum import IntEnum
from typing import NamedTuple

import orjson

from gateway.tags import Quality, Reason, Sample, Tag
from gateway.values import Value

Stored = int | float | str | bytes | None


class Kind(IntEnum):
    """The type of a value, where the column `kind` is not NULL."""

    BOOL = 0  # written as 0 or 1
    LONG = 1  # a whole number beyond 64 bits with sign, written in decimal
    NOT_A_NUMBER = 2  # SQLite would store NULL
    ODD_TEXT = 3  # text with surrogates, which is no valid UTF-8, as bytes
    LIST = 4  # an array, written as JSON


class Row(NamedTuple):
    """The columns `time, value, kind, bad`."""

    time: int
    value: Stored
    kind: int | None
    bad: str | None


def to_row(sample: Sample) -> Row:
    value, kind = _stored(sample.value)
    bad = None if sample.quality is Quality.GOOD else sample.reason or ""
    return Row(sample.time, value, kind, None if bad is None else str(bad))


def from_row(tag: Tag, time: int, stored: Stored, kind: int | None, bad: str | None) -> Sample:
    value = _value(stored, kind)
    if bad is None:
        return Sample(tag, value, Quality.GOOD, time)
    return Sample(tag, value, Quality.BAD, time, _REASONS.get(bad))


def step(
    time: int, stored: Stored | Value, kind: int | None, bad: str | None
) -> tuple[int, Value | None, str | None]:
    """Returns the time, the value, and the reason why there is none."""
    if bad is not None:
        return time, None, bad
    value = stored if kind is None and not isinstance(stored, bytes) else _value(stored, kind)
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return time, None, Reason.NOT_A_NUMBER.value
    return time, value, None


_REASONS = {reason.value: reason for reason in Reason}


def _stored(value: Value | None) -> tuple[Stored, int | None]:
    match value:
        case bool():
            return int(value), Kind.BOOL
        case int():
            return (value, None) if -(2**63) <= value < 2**63 else (str(value), Kind.LONG)
        case float():
            return (None, Kind.NOT_A_NUMBER) if math.isnan(value) else (value, None)
        case str():
            try:
                value.encode()
            except UnicodeEncodeError:
                return value.encode("utf-8", "surrogatepass"), Kind.ODD_TEXT
            return value, None
        case tuple():
            return orjson.dumps(value).decode(), Kind.LIST
        case None:
            return None, None


def _value(stored: Stored | Value, kind: int | None) -> Value | None:
    match kind, stored:
        case None, int() | float() | str():
            return stored
        case Kind.BOOL, _:
            return bool(stored)
        case Kind.LONG, str():
            return int(stored)
        case Kind.NOT_A_NUMBER, _:
            return math.nan
        case Kind.ODD_TEXT, bytes():
            return stored.decode("utf-8", "surrogatepass")
        case Kind.LIST, str():
            return tuple(orjson.loads(stored))
        case _:
            return None
