"""Samples, descriptions and outcomes <-> the JSON that travels on Zenoh.

A value is `{"value": 12.5, "quality": "good", "time": "2026-11-20T12:00:00.123456Z"}`; one that is
not known has `"value": null, "quality": "bad"` and a `reason`, where there is one with a sentence
for people in `detail`. Integers stay JSON integers whatever their size: beyond 2**53 a reader in
JavaScript must parse them itself.
"""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import lru_cache
from typing import Never

import orjson

from gateway.engine.requests import CommandResult
from gateway.errors import BadValue, Busy, GatewayError, LineDown, Offline, Refused
from gateway.tags import Quality, Reason, Sample, Tag, WriteResult
from gateway.values import Value

LONGEST_WRITE = 64 * 1024  # bytes: a tag holds 250 characters at most, the rest is room
_LONGEST_REASON = 300


class Problem(StrEnum):
    """The words of the contract for what did not work."""

    NOT_WRITABLE = "not-writable"
    BAD_VALUE = "bad-value"
    REFUSED = "refused"  # by the device; `code` is its own
    UNCLEAR = "unclear"  # it may or may not have been done
    LINE_DOWN = "line-down"
    NO_REPLY = "no-reply"  # the device is silent; nothing was sent
    BUSY = "busy"  # too much is waiting; nothing was done
    UNKNOWN_TAG = "unknown-tag"
    NOT_ALLOWED = "not-allowed"  # not to this asker: the token is missing or nobody's
    BAD_QUERY = "bad-query"  # a read that cannot be understood
    NO_HISTORY = "no-history"  # a read of the past, where none is kept


@dataclass(frozen=True, slots=True)
class Failure:
    """It did not work, or nobody can say whether it did."""

    problem: Problem
    reason: str
    code: str | None = None


@dataclass(frozen=True, slots=True)
class WriteOutcome:
    """One write or command and what became of it, for log, history and the `writes` key.

    `key` is that of the value that was written, or the command's own; `value` what was asked for
    (None if it could not be understood), or the command's argument; `time` when it ended (ns
    since 1970), `by` the asker, where Zenoh tells.
    """

    key: str
    value: Value | None
    result: WriteResult | CommandResult | Failure
    time: int
    took: float
    by: str | None = None
    command: bool = False


def failure(error: GatewayError) -> Failure:
    """What an error means to the one who asked. Whatever is not known to be undone is unclear."""
    reason = str(error) or type(error).__name__
    match error:
        case BadValue():
            return Failure(Problem.BAD_VALUE, reason)
        case Refused(code=code):
            return Failure(Problem.REFUSED, reason, code)
        case LineDown():
            return Failure(Problem.LINE_DOWN, reason)
        case Busy():
            return Failure(Problem.BUSY, reason)
        case Offline():
            return Failure(Problem.NO_REPLY, reason)
        case _:
            return Failure(Problem.UNCLEAR, reason)


# -- out ---------------------------------------------------------------------------------------


def value(sample: Sample) -> bytes:
    return orjson.dumps(_sample(sample))


def bare(sample: Sample) -> bytes | None:
    """The value alone, as text; None when it is not known. `about` is the rest."""
    known = _sample(sample)["value"]
    match known:
        case None:
            return None
        case str():
            return known.encode()
        case _:
            return orjson.dumps(known)


def about(sample: Sample) -> bytes:
    """`{"quality": "good", "time": …}`, and a `reason` when bad."""
    return orjson.dumps({name: what for name, what in _sample(sample).items() if name != "value"})


def block(samples: Iterable[Sample]) -> bytes:
    """`{tag: {value, quality, time}}` of one device."""
    return orjson.dumps({sample.tag.name: _sample(sample) for sample in samples})


def meta(tag: Tag) -> bytes:
    """What a tag is: type, address, unit, interval, limits."""
    rule, deadband = tag.write, tag.deadband
    fields = {
        "type": str(tag.layout.type),
        "address": tag.text,
        "unit": tag.unit,
        "description": tag.description,
        "every": tag.every,
        "scale": tag.scale,
        "offset": tag.offset,
        "publish": tag.publish.value,
        "deadband": None
        if deadband is None
        else {"amount": deadband.amount, "percent": deadband.percent},
        "heartbeat": tag.heartbeat,
        "history": tag.history,
        "payload": tag.payload.value,
        "event": tag.event,
        "write": None
        if rule is None
        else {"min": rule.min, "max": rule.max, "verify": rule.verify},
    }
    return orjson.dumps(fields)


def outcome(result: WriteResult | Failure) -> bytes:
    """The answer to one write, or the error of any query."""
    return orjson.dumps(_result(result))


def write_outcome(done: WriteOutcome) -> bytes:
    """The line of the audit trail; `outcome` is `written`, `obeyed` or the word for what went
    wrong."""
    line: dict[str, object] = {
        "key": short(done.key),
        "value": shown(done.value),
        "time": rfc3339(done.time),
        "took": round(done.took, 6),
        "by": done.by,
    }
    match done.result:
        case WriteResult(verified=verified):
            line |= {"outcome": "written", "verified": verified}
        case CommandResult(answer):
            line |= {"outcome": "obeyed", "answer": short(answer)}
        case Failure(problem, reason, code):
            line |= {"outcome": problem.value, "code": code, "reason": short(reason)}
    return orjson.dumps(line)


def document(fields: Mapping[str, object]) -> bytes:
    """A status document; what JSON does not know is written as text."""
    return orjson.dumps(fields, default=str, option=orjson.OPT_NON_STR_KEYS)


@lru_cache(maxsize=256)  # samples of one scan have one time
def rfc3339(time: int) -> str:
    """Nanoseconds since 1970 as `2026-11-20T12:00:00.123456Z`."""
    return f"{_second(time // 1_000_000_000)}.{time // 1000 % 1_000_000:06}Z"


def _sample(sample: Sample) -> dict[str, Value | None]:
    known = sample.value
    time = rfc3339(sample.time)
    reason = sample.reason
    if sample.quality is Quality.GOOD:
        # JSON has no NaN and no infinity: they must not become a good null.
        if known is not None and not (isinstance(known, float) and not math.isfinite(known)):
            return {"value": known, "quality": "good", "time": time}
        reason = Reason.NOT_A_NUMBER
    told: dict[str, Value | None] = {
        "value": None,
        "quality": "bad",
        "reason": None if reason is None else reason.value,
        "time": time,
    }
    if sample.detail:
        told["detail"] = short(sample.detail)
    return told


def _result(result: WriteResult | Failure) -> dict[str, Value | None]:
    match result:
        case WriteResult(known, time, took, verified, acknowledged):
            return {
                "value": known,
                "time": rfc3339(time),
                "verified": verified,
                "acknowledged": acknowledged,
                "took": round(took, 6),
            }
        case Failure(problem, reason, code):
            return {"error": problem.value, "code": code, "reason": short(reason)}


def shown(asked: Value | None) -> Value | None:
    """What was asked for, if it is of a size to be shown; 64 bits are all that orjson writes."""
    match asked:
        case str():
            return short(asked)
        case int() if not -(2**63) <= asked < 2**64:
            return short(str(asked))
        case _:
            return asked


def short(text: str) -> str:
    """Never an endless answer, and nothing that is no UTF-8, whatever the asker sent."""
    text = text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}…"
    return text.encode("utf-8", "replace").decode()


@lru_cache(maxsize=256)
def _second(seconds: int) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")


# -- in ----------------------------------------------------------------------------------------


def wanted(payload: bytes) -> Value:
    """The value a write asks for: a JSON scalar, or `{"value": scalar}`. Raises `BadValue`."""
    if not payload.strip():
        raise BadValue("the payload is empty: send a JSON value such as 12.5")
    if len(payload) > LONGEST_WRITE:
        raise BadValue(f"the payload has {len(payload)} bytes, more than {LONGEST_WRITE}")
    try:
        # Not orjson: it turns integers beyond 64 bits into floats, which then may fit.
        found = json.loads(
            payload.decode(),
            parse_constant=_no_number,
            parse_float=_finite,
            object_pairs_hook=_only_value,
        )
    except UnicodeDecodeError:
        raise BadValue("the payload is no UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise BadValue(f"the payload is no JSON: {error}") from None
    except RecursionError:
        raise BadValue("the payload is nested too deeply") from None
    except BadValue:
        raise
    except ValueError:  # an integer of more than 4300 digits
        raise BadValue("the number in the payload is too long") from None
    return _scalar(found.value if isinstance(found, _Wrapped) else found)


@dataclass(frozen=True, slots=True)
class _Wrapped:
    value: object


def _only_value(pairs: list[tuple[str, object]]) -> _Wrapped:
    if [key for key, _ in pairs] != ["value"]:
        raise BadValue('an object must hold "value" once, and nothing else')
    return _Wrapped(pairs[0][1])


def _no_number(text: str) -> Never:
    raise BadValue(f"{text} is no number in JSON")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise BadValue("the number in the payload is too large")
    return number


def _scalar(found: object) -> Value:
    match found:
        case bool() | int() | float():
            return found
        case str():
            if any("\ud800" <= character <= "\udfff" for character in found):
                raise BadValue("the text holds half a surrogate pair")
            return found
        case _:
            raise BadValue('send one JSON value: true, 12.5, "AB", or {"value": 12.5}')
