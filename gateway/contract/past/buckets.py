"""Buckets of time with the smallest, the largest, the mean and the last value: what a chart draws.

A value is valid until the next sample of its tag. So the mean is weighted by time, and a bucket
without a sample has the value that was valid in it. Time without a valid value is a gap: it is in
no mean, and a bucket with a gap is never `good`.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import orjson

from gateway.contract.past.timerange import EARLIEST, TimeRange
from gateway.errors import BadValue
from gateway.tags import Tag
from gateway.tags.timestamps import rfc3339
from gateway.values import Value
from gateway.values.numerals import Scalar

MOST_BUCKETS = 10_000  # of one tag, in one answer
_WITHOUT_MEAN = (str, tuple)  # texts and arrays
NOT_RECORDED = "not-recorded"  # nothing is known: before the first sample, or no gateway ran

# From `time` on (ns since 1970) the value is valid; None: there is none, for the reason.
Step = tuple[int, Value | None, str | None]


class Bucket(NamedTuple):
    """One bucket. Times are ns since 1970; `end` is the end of its part in the asked period.

    `known`: ns with a valid value. The four values are of this time; None if there was none, and
    the first three are None for texts and arrays too. `good` and `bad` count samples.
    """

    time: int
    start: int  # of its part in the period
    end: int
    known: int
    good: int
    bad: int
    min: Scalar | None
    max: Scalar | None
    mean: float | None
    last: Value | None
    reason: str | None  # of the last gap

    @property
    def quality(self) -> str:
        """`good`: a value was valid all the time. `partial`: there is a gap. `bad`: no value."""
        if self.known == self.end - self.start and not self.bad:
            return "good"
        return "partial" if self.known or self.good else "bad"


class Now(NamedTuple):
    """The time of a query, in ns since 1970. `is_valid`: the last sample is valid until now."""

    time: int
    is_valid: bool


@dataclass(slots=True)
class _Open:
    """The bucket that gets samples now."""

    time: int
    start: int
    known: int = 0
    good: int = 0
    bad: int = 0
    min: Scalar | None = None
    max: Scalar | None = None
    mean: float = 0.0
    last: Value | None = None
    reason: str | None = None
    has_begun: bool = False  # the value at its beginning counts only if it stays valid

    def enter(self, value: Value) -> None:
        """The value is valid from now on."""
        self.has_begun = True
        self.last = value
        if isinstance(value, (str, tuple)):
            self.mean = math.nan
        elif self.min is None or self.max is None:
            self.min = self.max = value
        elif value < self.min:  # type: ignore[operator]  # both are numbers
            self.min = value
        elif value > self.max:  # type: ignore[operator]  # as above
            self.max = value

    def count(self, value: Value | None, reason: str | None) -> None:
        """Counts a sample at this moment."""
        if value is not None:
            self.good += 1
            self.enter(value)
        elif reason != NOT_RECORDED:
            self.bad += 1
            self.reason = reason

    def hold(self, value: Value | None, reason: str | None, duration: int) -> None:
        """The value stays valid for this time, in ns; without a value it is a gap."""
        if value is None:
            self.reason = reason
            return
        if not self.has_begun:
            self.enter(value)
        self.known += duration
        # A running mean: a sum of large numbers would overflow. The value is a number here.
        if value.__class__ not in _WITHOUT_MEAN:
            self.mean += (value - self.mean) * (duration / self.known)  # type: ignore[operator]

    def closed(self, end: int) -> Bucket:
        return Bucket(
            self.time,
            self.start,
            end,
            self.known,
            self.good,
            self.bad,
            self.min,
            self.max,
            self._mean(),
            self.last,
            self.reason,
        )

    def _mean(self) -> float | None:
        """Rounding does not lead out of the range of the values. Texts and arrays have no mean."""
        if self.min is None or self.max is None or math.isnan(self.mean):
            return None
        if not self.known:  # a sample at the last moment
            return float(self.last or 0)  # type: ignore[arg-type]  # a number
        return min(max(self.mean, float(self.min)), float(self.max))


def buckets(
    steps: Iterable[Step],
    width: int,
    period: TimeRange,
    now: int,
    most: int = MOST_BUCKETS,
    *,
    from_start: bool = False,
) -> Iterator[Bucket]:
    """Divides the period into buckets of `width` ns, which begin at multiples of it since 1970, or
    since the start of the period.

    `steps` are in the order of time; those before the period tell the value at its beginning. An
    open period begins with the first step, and every period ends with `now` or the last step.
    Yields nothing without a step. Raises `BadValue` for more than `most` buckets.
    """
    first, last = period
    held: Value | None = None
    why: str | None = NOT_RECORDED
    begun = False
    bucket, begin, since, end = _Open(0, 0), first, first, 0
    for time, value, reason in steps:
        if not begun:
            begun = True
            begin = since = time if first == EARLIEST else first
            _check(since, min(last, max(now, time)), width, most)
            offset = since % width if from_start else 0
            begins = (since - offset) // width * width + offset
            bucket, end = _Open(begins, since), begins + width
        if time > last:
            break
        while time >= end:
            _check(begin, end, width, most)  # the clock may have been wrong once
            bucket.hold(held, why, end - since)
            yield bucket.closed(end)
            bucket, since, end = _Open(end, end), end, end + width
        if time > since:
            bucket.hold(held, why, time - since)
            since = time
        held, why = value, reason
        if time >= first:
            bucket.count(value, reason)
    if not begun:
        return
    stop = min(last + 1, max(now, since + bool(bucket.good or bucket.bad)))
    while since < stop:
        until = min(end, stop)
        bucket.hold(held, why, until - since)
        yield bucket.closed(until)
        bucket, since, end = _Open(end, until), until, end + width


def _check(first: int, last: int, width: int, most: int) -> None:
    count = (last - first) // width + 1
    if count > most:
        needed = -(-(last - first + 1) // most / 10**9)
        raise BadValue(
            f"the range has {count} buckets, more than {most}: take a shorter range, or "
            f"buckets of at least {max(needed, 0.001):.3g} s"
        )


def fields(tag: Tag, bucket: Bucket, aggregates: Sequence[str]) -> dict[str, object]:
    """Returns a bucket for JSON, on Zenoh and HTTP alike.

    `{"time": "2026-11-20T12:00:00.000000Z", "quality": "good", "min": 1.5, "max": 3.0,
    "mean": 2.25, "last": 3.0, "good": 12, "bad": 0, "known": 60.0}`: `time` is the beginning,
    `known` the seconds with a valid value. A bucket with a gap is `partial` or `bad`, with a
    `reason`. One without a valid value has null for all values. `origin` as in a value.
    """
    values = bucket._asdict()
    found: dict[str, object] = {"time": rfc3339(bucket.time), "quality": bucket.quality}
    found |= {name: values[name] for name in aggregates}
    found |= {"good": bucket.good, "bad": bucket.bad, "known": round(bucket.known / 1e9, 6)}
    if bucket.quality != "good":
        found["reason"] = bucket.reason
    if (origin := tag.origin.word) is not None:
        found["origin"] = origin
    return found


def document(tag: Tag, bucket: Bucket, aggregates: Sequence[str]) -> bytes:
    return orjson.dumps(fields(tag, bucket, aggregates))
