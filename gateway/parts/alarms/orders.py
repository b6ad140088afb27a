"""The orders of operators: acknowledge, shelve, take out of service, and back."""

from enum import StrEnum
from typing import NamedTuple

import orjson

from gateway.errors import BadValue

LONGEST_NAME, LONGEST_REASON = 100, 200  # characters
_LONGEST = 2000  # bytes of an order
_MEANT = 'send {"by": "the operator\'s name"}'
_FIELDS = {"by", "raised", "do", "reason", "seconds"}


class Do(StrEnum):
    """The words of `do`."""

    ACKNOWLEDGE = "acknowledge"
    SHELVE = "shelve"
    UNSHELVE = "unshelve"
    OUT_OF_SERVICE = "out-of-service"
    IN_SERVICE = "in-service"


class Order(NamedTuple):
    """One order about one alarm."""

    by: str
    do: Do = Do.ACKNOWLEDGE
    raised: str | None = None  # the alarm that the operator saw
    reason: str = ""
    seconds: float = 0.0  # of a shelving


def parse_order(data: bytes, longest: float) -> Order:
    """`longest`: seconds that an alarm may be shelved. Raises `BadValue`."""
    if len(data) > _LONGEST:
        raise BadValue(f"the payload has {len(data)} bytes, more than {_LONGEST}")
    try:
        found = orjson.loads(data)
    except orjson.JSONDecodeError:
        raise BadValue(f"the payload is no JSON: {_MEANT}") from None
    if not isinstance(found, dict) or not found.keys() <= _FIELDS:
        raise BadValue(f"the payload is no acknowledgement: {_MEANT}")
    raised, do = found.get("raised"), found.get("do", Do.ACKNOWLEDGE)
    if raised is not None and not isinstance(raised, str):
        raise BadValue("raised is no time: send it as the alarm's document has it")
    if do not in [*Do]:
        raise BadValue(f"do is none of {', '.join(Do)}")
    by = _text(found.get("by"), "name of the operator", LONGEST_NAME, f" is missing: {_MEANT}")
    reason, seconds = "", 0.0
    if do in (Do.SHELVE, Do.OUT_OF_SERVICE):
        reason = _text(found.get("reason"), "reason", LONGEST_REASON, " is missing")
    if do == Do.SHELVE:
        asked = found.get("seconds")
        if isinstance(asked, (int, float)) and not isinstance(asked, bool):
            seconds = float(asked)
        if not 1 <= seconds <= longest:
            raise BadValue(f"seconds is no number from 1 to {longest:.0f}: shelving has an end")
    return Order(by, Do(do), raised, reason, seconds)


def _text(found: object, what: str, longest: int, missing: str) -> str:
    if not isinstance(found, str) or not found.strip():
        raise BadValue(f"the {what}{missing}")
    if len(found) > longest or not found.isprintable():
        raise BadValue(f"the {what} is longer than {longest}, or not printable")
    return found.strip()
