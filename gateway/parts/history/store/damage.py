"""The damaged places of the history file that queries have found, for the status and the log."""

import threading
from collections.abc import Iterable

import structlog

from gateway.parts.history.answers.recent import Identity, SortedRun
from gateway.tags.timestamps import rfc3339

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

_MOST_LOGGED = 20  # runs; the status has all


class Damage:
    """Called by any thread."""

    def __init__(self, most_logged: int = _MOST_LOGGED) -> None:
        self._most_logged = most_logged
        self._lock = threading.Lock()
        self._runs: dict[tuple[Identity | None, SortedRun], str] = {}

    def found(self, file: Identity | None, run: SortedRun, why: str) -> None:
        with self._lock:
            if (file, run) in self._runs:
                return
            self._runs[file, run] = why
            known = len(self._runs)
        if known <= self._most_logged:
            log.error("history damaged", first=rfc3339(run.first), last=rfc3339(run.last), why=why)

    def sentence(self, file: Identity | None, runs: Iterable[SortedRun]) -> str | None:
        """Returns a sentence about the damage in these runs, None if there is none."""
        with self._lock:
            found = [run for run in runs if (file, run) in self._runs]
        if not found:
            return None
        first = rfc3339(min(run.first for run in found))
        last = rfc3339(max(run.last for run in found))
        return f"the file is damaged: samples between {first} and {last} are lost"
