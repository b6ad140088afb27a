"""Samples <-> rows of the file, without any change of value or type.

The columns are readable with any SQLite tool: `value` is the number or text itself, `kind` marks
types that SQLite lacks (see `Kind`), `bad` is NULL for a good sample and otherwise the reason.
Each row has a checksum: a flipped bit makes no other value.
"""

import marshal
import math
from collections.abc import Sequence
from typing import Any
from zlib import crc32

import orjson

from gateway.tags import Quality, Reason, Sample, Tag
from gateway.values import Value

Stored = int | float | str | bytes | None


class Kind:
    """The type of a value, where the column `kind` is not NULL."""

    BOOL = 0  # written as 0 or 1
    LONG = 1  # a whole number beyond 64 bits with sign, written in decimal
    NOT_A_NUMBER = 2  # SQLite would store NULL
    ODD_TEXT = 3  # text with surrogates, which is no valid UTF-8, as bytes
    LIST = 4  # an array, written as JSON


# The columns `id, tag, time, value, kind, bad, sum`. The numbers of samples have no gaps.
StoredRow = tuple[int, int, int, Stored, int | None, str | None, int]


def checksum(row: tuple[Any, ...]) -> int:
    """marshal's second format never changes, and takes a sixth of the time of `repr`."""
    return crc32(marshal.dumps(row, 2)) - 2**31  # takes four bytes in the file


def to_row(sample: Sample) -> tuple[int, Stored, int | None, str | None]:
    """Returns the columns `time, value, kind, bad`."""
    value, kind = _stored(sample.value)
    bad = None
    if sample.quality is not Quality.GOOD:
        bad = str(sample.reason or "")
    return sample.time, value, kind, bad


def with_checksum(number: int, tag: int, sample: Sequence[Stored]) -> StoredRow:
    """Returns the row of a sample, with its checksum."""
    row = (number, tag, *sample)
    return (*row, checksum(row))  # type: ignore[return-value]  # the columns of `to_row`


def from_row(tag: Tag, time: int, stored: Stored, kind: int | None, bad: str | None) -> Sample:
    value = _value(stored, kind)
    if bad is None:
        return Sample(tag, value, Quality.GOOD, time)
    quality = Quality.BAD if value is None else Quality.UNCERTAIN
    return Sample(tag, value, quality, time, _REASONS.get(bad))


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
