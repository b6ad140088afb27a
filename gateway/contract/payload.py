"""Samples, descriptions and outcomes -> the JSON that travels on Zenoh.

A value is `{"value": 12.5, "quality": "good", "time": "2026-11-20T12:00:00.123456Z"}`. An unknown
value has `"value": null, "quality": "bad"` and a `reason`, in some cases with a sentence for people
in `detail`. A value with a name has it in `text`. One that is no plain reading of a device has its
`origin`: `simulated`, `replayed`, `held` or `computed`. One at an end of its clamp is `limited`:
`low` or `high`. One outside the range of its sensor is `uncertain`, with a `reason`. Integers stay
JSON integers whatever their size: beyond 2**53 a reader in JavaScript must parse them itself.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import orjson

from gateway import errors
from gateway.contract.documents.requests import (
    CommandDocument,
    FailureDocument,
    GroupDocument,
    Logged,
    OutcomeDocument,
    OutcomeWord,
    WrittenDocument,
)
from gateway.contract.documents.values import (
    KnownValue,
    PlaceDocument,
    UncertainValue,
    UnknownValue,
    ValueDocument,
)
from gateway.contract.problems import PROBLEMS, Failure, Problem
from gateway.engine.jobs.requests import CommandResult, Peeked
from gateway.tags import Quality, Reason, Sample, WriteResult
from gateway.tags.sample import has_json
from gateway.tags.tag import READ, OriginWord
from gateway.tags.timestamps import rfc3339
from gateway.values import Value
from gateway.values.numerals import Scalar

LONGEST_REASON = 300
LOGGED_ELEMENTS = 128  # of a longer array the record has the beginning, as text
_GOOD = Quality.GOOD  # looking up a member of an enumeration takes 0.2 µs


@dataclass(frozen=True, slots=True)
class GroupResult:
    """The outcome of each tag of a group, by name in their order; `took` in seconds."""

    tags: Mapping[str, WriteResult | Failure]
    took: float

    @property
    def failure(self) -> Failure | None:
        """The first tag that was not written, for the whole; None: all were.

        Its own error only where certainly no tag was written.
        """
        failed = {name: end for name, end in self.tags.items() if isinstance(end, Failure)}
        if not failed:
            return None
        causes = {n: end for n, end in failed.items() if end.problem is not Problem.NOT_SENT}
        first = next(iter((causes or failed).values()))
        problem, done = first.problem, len(self.tags) - len(failed)
        if any(end.problem is Problem.UNCLEAR for end in failed.values()):
            problem = Problem.UNCLEAR
        elif done:
            problem = Problem.INCOMPLETE
        reasons = "; ".join(f"{name}: {end.reason}" for name, end in causes.items())
        count = f"{done} of {len(self.tags)} tags were written"
        return Failure(problem, f"{count}: {reasons}" if causes else count, first.code)


# The end of any request. `bytes`: the document of an order, as JSON.
Result = WriteResult | CommandResult | Peeked | Failure | GroupResult | bytes


@dataclass(frozen=True, slots=True)
class WriteOutcome:
    """One write or command with its result, for log, history and the `writes` key.

    `key` is the key of the written value, or of the command; `value` the requested value (None if
    it could not be parsed), or the command's argument; `time` is when it ended (ns since 1970),
    `took` is in seconds, `by` names the client, if Zenoh or a token does.
    """

    key: str
    value: Value | None
    result: WriteResult | CommandResult | Failure
    time: int
    took: float
    by: str | None = None
    command: bool = False


def failure(error: errors.GatewayError) -> Failure:
    """Translates an error for the client. An error after which the request may have been done is
    unclear."""
    kinds = type(error).__mro__
    problem = next((PROBLEMS[kind] for kind in kinds if kind in PROBLEMS), Problem.UNCLEAR)
    code = error.code if isinstance(error, errors.Refused) else None
    return Failure(problem, str(error) or type(error).__name__, code)


def audited(error: errors.GatewayError) -> Failure:
    """Translates an error for the audit. The repetition itself was not sent."""
    if isinstance(error, errors.Repeated):
        return Failure(Problem.NOT_ALLOWED, str(error))
    return failure(error)


# -- out ---------------------------------------------------------------------------------------


def value(sample: Sample) -> bytes:
    """The value with quality and time. A good one in half the time that `sample_fields` takes."""
    known, tag = sample.value, sample.tag
    if sample.quality is not _GOOD or not has_json(known) or tag.shaping.names is not None:
        return orjson.dumps(sample_fields(sample))
    origin = None if tag.origin is READ else tag.origin.word
    limited = None if tag.shaping.clamp is None else tag.shaping.limited(known)
    return b'{"value":%b%b' % (orjson.dumps(known), end_of_good(sample.time, origin, limited))


@lru_cache(maxsize=256)  # the samples of one scan share one time
def end_of_good(time: int, origin: str | None = None, limited: str | None = None) -> bytes:
    """The JSON of a good value after the value itself."""
    named = (("origin", origin), ("limited", limited))
    known = "".join(f',"{name}":"{word}"' for name, word in named if word is not None)
    return f',"quality":"good","time":"{rfc3339(time)}"{known}}}'.encode()


@lru_cache(maxsize=256)  # those of one device turn bad at one time
def _unknown(why: Reason, time: int, detail: str, origin: OriginWord | None) -> UnknownValue:
    found = UnknownValue(value=None, quality="bad", reason=why, time=rfc3339(time))
    if detail:
        found["detail"] = short(detail)
    if origin is not None:
        found["origin"] = origin
    return found


def value_text(sample: Sample) -> bytes | None:
    """The value alone, as text; None if it is unknown. `attachment` holds the rest."""
    if (known := sample_fields(sample)["value"]) is None:
        return None
    return known.encode() if isinstance(known, str) else orjson.dumps(known)


def attachment(sample: Sample) -> bytes:
    """`{"quality": "good", "time": …}`, and a `reason` if it is not good."""
    rest = {name: item for name, item in sample_fields(sample).items() if name != "value"}
    return orjson.dumps(rest)


def block(samples: Iterable[Sample]) -> bytes:
    """`{tag: {value, quality, time}}` of one device."""
    return orjson.dumps({sample.tag.name: sample_fields(sample) for sample in samples})


def place(epoch: str, number: int) -> bytes:
    """The place of a block among those of its device: a consumer sees that it missed one."""
    return orjson.dumps(PlaceDocument(epoch=epoch, seq=number))


def outcome(result: Result) -> bytes:
    """The reply to a write, a command or a peek, or the error reply to any query."""
    match result:
        case bytes():
            return result
        case GroupResult(ends, took):
            tags = {short(name): _result(end) for name, end in ends.items()}
            whole: GroupDocument = {"tags": tags, "took": round(took, 6)}
            if (failed := result.failure) is not None:
                whole = {**_failure(failed), **whole}
            return orjson.dumps(whole)
        case CommandResult(answer, at, took):
            told = CommandDocument(answer=answer, time=rfc3339(at), took=round(took, 6))
            return orjson.dumps(told)
        case Peeked():
            return orjson.dumps({**result._asdict(), "time": rfc3339(result.time)})
        case _:
            return orjson.dumps(_result(result))


def failed(result: Result) -> Failure | None:
    """Returns the failure of a request, or of a group; None: all was done."""
    if isinstance(result, GroupResult):
        return result.failure
    return result if isinstance(result, Failure) else None


def write_outcome(ended: WriteOutcome) -> bytes:
    """One line of the audit trail; `outcome` is its `word`."""
    line: OutcomeDocument = {
        "key": short(ended.key),
        "value": loggable(ended.value),
        "time": rfc3339(ended.time),
        "took": round(ended.took, 6),
        "by": ended.by,
        "outcome": word(ended.result),
    }
    match ended.result:
        case WriteResult(verified=verified, origin=origin):
            line["verified"] = verified
            if origin is not None:
                line["origin"] = origin
        case CommandResult(answer):
            line["answer"] = short(answer)
        case Failure(_, reason, code):
            line["code"], line["reason"] = code, short(reason)
    return orjson.dumps(line)


def word(result: WriteResult | CommandResult | Failure) -> OutcomeWord:
    """`written`, `obeyed` or a `Problem`."""
    match result:
        case WriteResult():
            return "written"
        case CommandResult():
            return "obeyed"
        case Failure(problem):
            return problem


def document(found: object) -> bytes:
    """A status document; values of types that JSON lacks are written as text."""
    try:
        return orjson.dumps(found, default=str, option=orjson.OPT_NON_STR_KEYS)
    except TypeError:  # the name of a file can have bytes that are no text
        return json.dumps(found, default=str, ensure_ascii=False).encode(errors="replace")


def sample_fields(sample: Sample) -> ValueDocument:
    time, value, shaping = rfc3339(sample.time), sample.value, sample.tag.shaping
    reason, origin = sample.reason or Reason.NOT_A_NUMBER, sample.tag.origin.word
    if sample.quality is Quality.BAD or value is None or not has_json(value):
        return _unknown(reason, sample.time, sample.detail, origin).copy()
    known: KnownValue | UncertainValue = KnownValue(value=value, quality="good", time=time)
    if sample.quality is Quality.UNCERTAIN:
        known = UncertainValue(value=value, quality="uncertain", reason=reason, time=time)
        if sample.detail:
            known["detail"] = short(sample.detail)
    if shaping.names is not None and (text := shaping.names.text(value)) is not None:
        known["text"] = text
    if (end := shaping.limited(value)) is not None:
        known["limited"] = end
    if origin is not None:
        known["origin"] = origin
    return known


def _result(result: WriteResult | Failure) -> WrittenDocument | FailureDocument:
    match result:
        case WriteResult(known, time, took, verified, acknowledged, note, origin):
            fields: WrittenDocument = {
                "value": known,
                "time": rfc3339(time),
                "verified": verified,
                "acknowledged": acknowledged,
                "took": round(took, 6),
            }
            if note:
                fields["note"] = note
            if origin is not None:
                fields["origin"] = origin
            return fields
        case Failure():
            return _failure(result)


def _failure(failed: Failure) -> FailureDocument:
    return {"error": failed.problem, "code": failed.code, "reason": short(failed.reason)}


def loggable(requested: Value | None) -> Logged | None:
    """Limits a requested value to a printable size; orjson writes at most 64 bits."""
    if isinstance(requested, tuple):
        found = list(map(_loggable, requested))
        return found if len(found) <= LOGGED_ELEMENTS else short(orjson.dumps(found).decode())
    return None if requested is None else _loggable(requested)


def _loggable(requested: Scalar) -> Scalar:
    match requested:
        case str():
            return short(requested)
        case int() if not -(2**63) <= requested < 2**64:
            return short(str(requested))
        case _:
            return requested


def short(text: str) -> str:
    """Limits a text from a client to a printable length, and to valid UTF-8."""
    text = text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}…"
    return text.encode("utf-8", "replace").decode()
