"""The exchanges of a line for the strip chart: recorded only while a page watches the line."""

import asyncio
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from gateway.line.exchanges import Exchange, decoded
from gateway.line.wire_log import Event, Performed
from gateway.plant.plant import Plant

MOST_KEPT = 600  # exchanges of a line; a page asks four times a second


class Numbered(NamedTuple):
    """One exchange of a line. Times by the loop's clock."""

    number: int
    begun: float
    ended: float
    exchange: Exchange


class Recorder:
    """The last exchanges of one line."""

    def __init__(self) -> None:
        self.watching = 0  # pages
        self._kept: deque[tuple[int, Performed]] = deque(maxlen=MOST_KEPT)
        self._number = 0

    def record(self, event: Event) -> None:
        if isinstance(event, Performed):
            self._number += 1
            self._kept.append((self._number, event))

    def since(self, number: int) -> list[Numbered]:
        """Returns the exchanges after that number, decoded."""
        return [
            Numbered(own, one.begun, one.ended, decoded(one))
            for own, one in self._kept
            if own > number
        ]


class Wires:
    """The recorders of the watched lines."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._recorders: dict[str, Recorder] = {}

    @contextmanager
    def watched(self, line: str) -> Iterator[Recorder | None]:
        """Records the line. None: there is no such line."""
        wire_log = self._plant.wire_logs().get(line)
        if wire_log is None:
            yield None
            return
        recorder = self._recorders.setdefault(line, Recorder())
        if not recorder.watching:
            wire_log.listen(recorder.record)
        recorder.watching += 1
        try:
            yield recorder
        finally:
            recorder.watching -= 1
            if not recorder.watching:
                del self._recorders[line]
                wire_log.forget(recorder.record)


def as_fields(one: Numbered) -> list[object]:
    """Returns what the page gets; the begin in ms since 1970."""
    behind = time.time() - asyncio.get_running_loop().time()
    begun, took = (one.begun + behind) * 1000, one.ended - one.begun
    return [one.number, round(begun, 1), round(took, 4), *one.exchange]
