"""The jobs of a line as people read them: what was asked, what came back, how long it took."""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

from gateway.engine.jobs.jobs import (
    Answer,
    Confirm,
    Identify,
    Poll,
    Probe,
    ReadBack,
    Repeat,
    Settle,
    Transacted,
    WriteTogether,
    requests_of,
)
from gateway.engine.jobs.requests import Command, Write
from gateway.line.wire_log import Performed
from gateway.planning.planner import Block, describe
from gateway.tags import Sample
from gateway.values import Value

_VERBS = {
    Write: "write",
    WriteTogether: "write",
    ReadBack: "read back",
    Confirm: "confirm",
    Repeat: "repeat",
}
_MOST = 4  # values of a read, elements of an array


class Exchange(NamedTuple):
    """One job of a line, decoded."""

    device: str
    kind: str  # read, write, probe, wait, heard, other
    what: str  # `read D100..D119`
    result: str  # decoded values, or why it failed
    failed: bool


def decoded(performed: Performed) -> Exchange:
    """Returns the texts of a job and its result."""
    job, result = performed.job, performed.result
    kind, what = _what(job)
    failed = isinstance(result, Exception)
    if failed:
        text = str(result)
    elif isinstance(job, Poll):
        text = shown(samples_of(performed))
    else:
        text = ""
    return Exchange(job.device.name, kind, what, text, failed)


def heard(samples: Sequence[Sample]) -> Exchange:
    """Returns the texts of samples that arrived without a request of this gateway."""
    reasons = {f"{one.reason}: {one.detail}" for one in samples if one.value is None}
    text = "; ".join(sorted(reasons)) or shown(samples)
    return Exchange(samples[0].tag.device, "heard", "heard", text, bool(reasons))


def samples_of(performed: Performed) -> Sequence[Sample]:
    """Returns the samples of a good poll, without a time; of any other job none."""
    job, result = performed.job, performed.result
    if not isinstance(job, Poll) or isinstance(result, Exception):
        return ()
    units, span = cast("Sequence[Any]", result), job.block.span
    if job.span is not span:  # a longer one was read
        units = units[span.start - job.span.start :][: span.size]
    return _samples(job.block, units)


def _text(value: Value | None) -> str:
    """Returns a value, or the first elements of an array: `[1, 2, 3, 4 and 46 more]`."""
    if not isinstance(value, tuple):
        return str(value)
    more = f" and {len(value) - _MOST} more" if len(value) > _MOST else ""
    return f"[{', '.join(map(str, value[:_MOST]))}{more}]"


def shown(samples: Sequence[Sample]) -> str:
    """Returns the first values as `speed 12.5, level 3 and 4 more`."""
    first = [
        f"{one.tag.name} {_text(one.value)}" for one in samples[:_MOST] if one.value is not None
    ]
    more = len(samples) - len(first)
    return ", ".join(first) + (f" and {more} more" if more else "")


def _what(job: Transacted) -> tuple[str, str]:
    match job:
        case Poll(block=block):
            return "read", f"read {describe(block)}"
        case Probe():
            return "probe", "probe"
        case Identify():
            return "probe", "identity"
        case Settle():
            return "wait", "wait for a late reply"
        case Answer():
            return "other", "answer to its frame"
        case Command(name=name):
            return "write", f"command {name}"
    writes = ", ".join(
        f"{one.tag.name} = {_text(one.value)}" for one in requests_of(job) if isinstance(one, Write)
    )
    return "write", f"{_VERBS[type(job)]} {writes}"


def _samples(block: Block, units: Sequence[Any]) -> Sequence[Sample]:
    decoder = block.decoder
    return decoder.fields(units, 0) if block.of_fields else decoder.first(units, 0)
