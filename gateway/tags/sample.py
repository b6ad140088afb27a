"""Samples: the values of tags with their quality, time and reason."""

import math
from enum import StrEnum
from typing import Any, NamedTuple

from gateway.errors import Garbled
from gateway.tags.tag import OriginWord, Tag
from gateway.values import Value


class Quality(StrEnum):
    GOOD = "good"
    UNCERTAIN = "uncertain"  # read well, but the sensor may not measure
    BAD = "bad"


class Reason(StrEnum):
    """The cause of a sample that is not good. Only `out-of-range` has a value."""

    STARTING = "starting"  # not read yet
    NO_REPLY = "no-reply"  # the device does not reply
    GARBLED = "garbled"  # the device replies, but no reply can be decoded
    REFUSED = "refused"  # an error reply: the device does not have this address
    LINE_DOWN = "line-down"  # the port is closed
    MAINTENANCE = "maintenance"  # another program has the wire
    OVERDUE = "overdue"  # the device replies, but the last read of this tag is too old
    DISABLED = "disabled"  # `enabled: false` in the file
    NOT_A_NUMBER = "not-a-number"  # a good read, but no value of the tag's type (NaN, bad BCD)
    WRONG_DEVICE = "wrong-device"  # the device that replies is not the one of the file
    OUT_OF_RANGE = "out-of-range"  # the value is outside the range of its sensor


class Sample(NamedTuple):
    """A value of a tag as the device had it at `time`, or the reason why there is none.

    `time` is in nanoseconds since 1970, UTC: the arrival of the reply, or of the failure.
    """

    tag: Tag
    value: Value | None
    quality: Quality
    time: int
    reason: Reason | None = None
    detail: str = ""  # one sentence for people, or empty


def good(tag: Tag, value: Value, time: int) -> Sample:
    return Sample(tag, value, Quality.GOOD, time)


def uncertain(sample: Sample, detail: str = "") -> Sample:
    """Returns the good sample as one whose sensor may not measure."""
    return sample._replace(quality=Quality.UNCERTAIN, reason=Reason.OUT_OF_RANGE, detail=detail)


def converted(tag: Tag, key: Any, time: int) -> Sample:
    """Returns the sample for what `tag.convert` takes."""
    value = tag.convert(key)
    if value is None:
        return bad(tag, Reason.NOT_A_NUMBER, time)
    found, is_outside = good(tag, value, time), tag.range_check()
    return found if is_outside is None or not is_outside(key) else uncertain(found)


def of_field(tag: Tag, value: Value | Garbled, time: int) -> Sample:
    """Returns the sample for a field of a frame: its value, or the error that replaced it."""
    if isinstance(value, Garbled):
        return bad(tag, Reason.GARBLED, time, str(value))
    return converted(tag, value, time)


def bad(tag: Tag, reason: Reason, time: int, detail: str = "") -> Sample:
    return Sample(tag, None, Quality.BAD, time, reason, detail)


class WriteResult(NamedTuple):
    """An acknowledged or broadcast write and the value the device now holds."""

    value: Value
    time: int  # ns since 1970: the acknowledgement
    took: float  # seconds from submitting to the acknowledgement
    verified: bool = False  # read back and found equal
    acknowledged: bool = True  # False only for a broadcast: no device acknowledges it
    note: str = ""  # what the client must know of the way in which it was written
    origin: OriginWord | None = None  # unless a real device holds the value


def has_json(value: Value | None) -> bool:
    """JSON has no NaN and no infinity: they must not become a good null."""
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def has_value(sample: Sample) -> bool:
    """True if the sample is good, and a value that JSON has."""
    return sample.quality is Quality.GOOD and has_json(sample.value)
