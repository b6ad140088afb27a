"""Zenoh's `_time` ranges: `[now(-1h)..]`, `[2026-11-20T12:00:00Z..now()]`, `]a..b[`, `[..]`.

`[a` and `b]` include the bound, `]a` and `b[` exclude it; a missing bound is open. A bound is
RFC 3339 (UTC without a zone; a day or a minute is its beginning), `now()` or `now(-1h)`; a number
alone is seconds. A duration alone is the time until now.
"""

import re
from datetime import UTC, datetime
from typing import NamedTuple

from gateway.errors import BadValue
from gateway.values.numerals import nanoseconds

EARLIEST, LATEST = -(2**63), 2**63 - 1  # of a 64-bit column: the years 1677 to 2262

_NOW = re.compile(r"now\(([+-]?)(.*)\)\Z")
_RFC3339 = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2})(?:[T ]([0-9]{2}:[0-9]{2}(?::[0-9]{2})?)"
    r"(?:\.([0-9]{1,9}))?(Z|[+-][0-9]{2}:[0-9]{2})?)?\Z"
)


class TimeRange(NamedTuple):
    """From `first` to `last`, both included: ns since 1970."""

    first: int
    last: int


def time_range(text: str, now: int) -> TimeRange:
    """Parses the text of `_time=`; `now`: ns since 1970. Raises `BadValue`."""
    if nanoseconds(text):
        text = f"[now(-{text})..]"
    if len(text) < 4 or text[0] not in "[]" or text[-1] not in "[]" or ".." not in text:
        raise BadValue(f"_time={_short(text)} is no range such as [now(-1h)..] or [start..end]")
    start, _, end = text[1:-1].partition("..")
    first = _bound(start, now) if start else EARLIEST
    last = _bound(end, now) if end else LATEST
    if start and text[0] == "]":
        first += 1
    if end and text[-1] == "[":
        last -= 1
    return TimeRange(_clamped(first), _clamped(last))


def _bound(text: str, now: int) -> int:
    if match := _NOW.match(text):
        sign, length = match[1], match[2]
        if not sign and not length:
            return now
        return now - duration(length) if sign == "-" else now + duration(length)
    if match := _RFC3339.match(text):
        date, clock, fraction, zone = match.groups()
        zone = "+00:00" if zone in (None, "Z") else zone
        try:
            moment = datetime.fromisoformat(f"{date}T{clock or '00:00'}{zone}")
        except ValueError:
            raise BadValue(f"{_short(text)} is no time of the calendar") from None
        since = moment - datetime(1970, 1, 1, tzinfo=UTC)
        seconds = since.days * 86400 + since.seconds
        return seconds * 10**9 + int((fraction or "").ljust(9, "0"))
    raise BadValue(f"{_short(text)} is no time such as 2026-11-20T12:00:00Z or now(-1h)")


def duration(text: str) -> int:
    """Returns ns. Raises `BadValue`."""
    time = nanoseconds(f"{text}s" if text[-1:].isdigit() else text)
    if time is None:
        raise BadValue(f"{_short(text)} is no duration such as 500ms, 30m or 1h30m")
    return time


def _clamped(time: int) -> int:
    return max(EARLIEST, min(LATEST, time))


def _short(text: str) -> str:
    return repr(text[:60])
