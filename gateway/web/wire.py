"""The exchanges of a line for the strip chart: recorded only while a page watches the line."""

import asyncio
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

from gateway.engine.jobs import (
    Answer,
    Confirm,
    Poll,
    Probe,
    ReadBack,
    Repeat,
    Result,
    Settle,
    Transacted,
    WriteTogether,
    requests_of,
)
from gateway.engine.requests import Command, Write
from gateway.planning.planner import Block, describe
from gateway.web.sources import Plant

MOST_KEPT = 600  # exchanges of a line; a page asks four times a second
_VERBS = {
    Write: "write",
    WriteTogether: "write",
    ReadBack: "read back",
    Confirm: "confirm",
    Repeat: "repeat",
}
_SHOWN = 4  # values of a read


class Exchange(NamedTuple):
    """One job of a line. Times by the loop's clock."""

    number: int
    begun: float
    ended: float
    device: str
    kind: str  # read, write, probe, wait, other
    what: str  # decoded: `read D100..D119`
    result: str  # decoded values, or why it failed
    failed: bool


class Recorder:
    """The last exchanges of one line."""

    def __init__(self) -> None:
        self.watching = 0  # pages
        self._kept: deque[tuple[int, Transacted, Result, float, float]] = deque(maxlen=MOST_KEPT)
        self._number = 0

    def record(self, job: Transacted, result: Result, begun: float, ended: float) -> None:
        self._number += 1
        self._kept.append((self._number, job, result, begun, ended))

    def since(self, number: int) -> list[Exchange]:
        """Returns the exchanges after that number, decoded."""
        return [_decoded(*one) for one in self._kept if one[0] > number]


class Wires:
    """The recorders of the watched lines."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._recorders: dict[str, Recorder] = {}

    @contextmanager
    def watched(self, line: str) -> Iterator[Recorder | None]:
        """Records the line. None: there is no such line."""
        recorder = self._recorders.get(line) or Recorder()
        if line not in self._recorders and not self._plant.watch(line, recorder.record):
            yield None
            return
        self._recorders[line] = recorder
        recorder.watching += 1
        try:
            yield recorder
        finally:
            recorder.watching -= 1
            if not recorder.watching:
                del self._recorders[line]
                self._plant.watch(line, None)


def as_fields(exchange: Exchange) -> list[object]:
    """Returns what the page gets; the begin in ms since 1970."""
    behind = time.time() - asyncio.get_running_loop().time()
    begun, took = (exchange.begun + behind) * 1000, exchange.ended - exchange.begun
    return [exchange.number, round(begun, 1), round(took, 4), *exchange[3:]]


def _decoded(number: int, job: Transacted, result: Result, begun: float, ended: float) -> Exchange:
    kind, what = _what(job)
    failed = isinstance(result, Exception)
    if failed:
        text = str(result)
    elif isinstance(job, Poll):
        text = _values(job.block, cast("Sequence[Any]", result))
    else:
        text = ""
    return Exchange(number, begun, ended, job.device.name, kind, what, text, failed)


def _what(job: Transacted) -> tuple[str, str]:
    match job:
        case Poll(block=block):
            return "read", f"read {describe(block)}"
        case Probe():
            return "probe", "probe"
        case Settle():
            return "wait", "wait for a late reply"
        case Answer():
            return "other", "answer to its frame"
        case Command(name=name):
            return "write", f"command {name}"
    writes = ", ".join(
        f"{one.tag.name} = {one.value}" for one in requests_of(job) if isinstance(one, Write)
    )
    return "write", f"{_VERBS[type(job)]} {writes}"


def _values(block: Block, units: Sequence[Any]) -> str:
    decoder = block.decoder
    samples = decoder.fields(units, 0) if block.of_fields else decoder.first(units, 0)
    shown = [f"{one.tag.name} {one.value}" for one in samples[:_SHOWN] if one.value is not None]
    more = len(samples) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")
