"""The parameters of a query of the past, for Zenoh and HTTP alike.

`bucket=1min` divides the time, `agg=min,max,mean,last` chooses the values of each bucket,
`align=start` begins the first one with the range. `last=100` asks for the newest samples.
`quality=good` leaves out what is not good.
"""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import NamedTuple, Protocol

from gateway.contract.past.timerange import duration
from gateway.errors import BadValue

AGGREGATES = ("min", "max", "mean", "last")
MOST_LAST = 100_000  # samples of one tag
NAMES = ("bucket", "agg", "align", "last", "quality")
_ALSO = ("limit", "page", "after")
_OF_PAST = ("_time", "bucket", "last")
_LONGEST = 36500 * 86400 * 10**9  # ns


class Parameters(Protocol):
    """The parameters of a selector of Zenoh."""

    def is_empty(self) -> bool: ...

    def __contains__(self, name: str) -> bool: ...


class HistoryQuery(NamedTuple):
    """`bucket`: ns, None for samples. `last`: the newest samples, None for all. `from_start`:
    the first bucket begins with the range."""

    time_range: str
    bucket: int | None = None
    aggregates: tuple[str, ...] = AGGREGATES
    last: int | None = None
    only_good: bool = False
    from_start: bool = False


def is_of_past(parameters: Parameters) -> bool:
    """True for a query of samples, whether its parameters are right or not."""
    return not parameters.is_empty() and any(name in parameters for name in _OF_PAST)


def question(parameters: Mapping[str, str], time: str = "_time") -> HistoryQuery:
    """Parses the parameters; `time` names the one of the range. Raises `BadValue`."""
    _check_names(parameters, time)
    bucket, agg, last = (parameters.get(name) for name in ("bucket", "agg", "last"))
    align = parameters.get("align", "utc")
    quality = parameters.get("quality", "any")
    if quality not in ("good", "any"):
        raise BadValue(f"quality={quality[:40]} is neither good nor any")
    for name in ("agg", "align"):
        if name in parameters and bucket is None:
            given = parameters[name][:40]
            raise BadValue(f"{name}={given} needs a bucket, such as bucket=1min")
    if align not in ("start", "utc"):
        raise BadValue(f"align={align[:40]} is neither start nor utc")
    if bucket is not None and time not in parameters:
        raise BadValue(f"bucket={bucket[:40]} needs a range of time, such as {time}=[now(-1h)..]")
    asked = [name for name in ("bucket", "last", "limit", "page") if name in parameters]
    if asked[:1] in (["bucket"], ["last"]) and len(asked) > 1:
        raise BadValue(f"{asked[0]} and {asked[1]} exclude each other: send one of them")
    return HistoryQuery(
        parameters.get(time, "[..]"),
        None if bucket is None else _width(bucket),
        AGGREGATES if agg is None else _aggregates(agg),
        None if last is None else _last(last),
        quality == "good",
        align == "start",
    )


def _width(text: str) -> int:
    try:
        width = duration(text)
    except BadValue:
        raise BadValue(f"bucket={text[:40]} is no duration such as 10s, 1min or 1h") from None
    if not 0 < width <= _LONGEST:
        raise BadValue(f"bucket={text[:40]} must be longer than 0, and at most 100 years")
    return width


def _aggregates(text: str) -> tuple[str, ...]:
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in AGGREGATES:
            raise BadValue(f"agg={text[:40]}: {name[:40]!r} is none of {', '.join(AGGREGATES)}")
    return tuple(name for name in AGGREGATES if name in names)


def _last(text: str) -> int:
    if text.isascii() and text.isdigit() and len(text) < 9 and 1 <= int(text) <= MOST_LAST:
        return int(text)
    raise BadValue(f"last={text[:40]} is no count from 1 to {MOST_LAST}")


def _check_names(parameters: Mapping[str, str], time: str) -> None:
    """Zenoh ignores parameters that nobody knows; a misspelt one would change the answer."""
    known = {time, *NAMES, *_ALSO}
    for name in parameters:
        if name in known or name.startswith("_"):
            continue
        if close := get_close_matches(name.lower(), known, 1, 0.75):
            raise BadValue(f"{name[:40]} is no parameter: did you mean {close[0]}?")
