"""Every write and command with its outcome: in the log, on the `writes` key, in history.

A write or command that reached a device, or may have, is always reported: the line limits how
often that happens. Refusals before anything was sent come as fast as a client can send, so beyond
a burst they are only counted and summarised. History keeps them apart, so that they push out no
write that was sent.
"""

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol

import structlog

from gateway.contract import audited, payload
from gateway.contract.documents.state import OutcomesDocument
from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.contract.rate_limit import RateLimit
from gateway.engine.jobs.requests import CommandResult
from gateway.tags import WriteResult
from gateway.tags.timestamps import rfc3339

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

BURST = 300  # refusals reported one by one
EVERY = 1.0  # seconds between further ones: 20 MB of log a day at most
_FAILURE_EVENTS = {
    (False, False): audited.WRITE_FAILED,
    (False, True): audited.WRITE_UNCLEAR,
    (True, False): audited.COMMAND_FAILED,
    (True, True): audited.COMMAND_UNCLEAR,
}
_SENT = frozenset({Problem.UNCLEAR, Problem.REFUSED})
# Seconds: the upper ends of the ranges in which the times of writes and commands are counted.
TIMES = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)


class Record(Protocol):
    """Records an outcome as JSON. `time`: when it ended, in ns since 1970. Never blocks."""

    def __call__(self, time: int, outcome: str, /, *, refused: bool) -> None: ...


class Counts:
    """Every outcome since the start, and the times of those that reached a device."""

    def __init__(self) -> None:
        self._outcomes = Counter[str]()
        self._times = Counter[float]()
        self._seconds = 0.0

    def count(self, outcome: WriteOutcome, *, was_sent: bool) -> None:
        self._outcomes[payload.word(outcome.result)] += 1
        if was_sent:
            self._times[next((end for end in TIMES if outcome.took <= end), math.inf)] += 1
            self._seconds += outcome.took

    def document(self) -> OutcomesDocument:
        """`took`: how many took at most so many seconds."""
        took, so_far = {}, 0
        for end in TIMES:
            so_far += self._times[end]
            took[f"{end:g}"] = so_far
        return {
            "counts": dict(self._outcomes),
            "sent": self._times.total(),
            "seconds": round(self._seconds, 6),
            "took": took,
        }


class Audit:
    """Called with every outcome, on the event loop."""

    def __init__(
        self,
        publish: Callable[[bytes], None],
        record: Record | None = None,
    ) -> None:
        """`publish` gets the outcome as JSON. It must not block."""
        self._publish = publish
        self._record = record
        self.counts = Counts()
        self._refusals = RateLimit(BURST, EVERY)
        self._untold = Counter[str]()  # refusals of each kind since the last summary
        self._ends: dict[str | None, Problem | None] = {}  # of the last write of each transfer

    @property
    def suppressed(self) -> int:
        """Refusals that were only counted, since the start."""
        return self._refusals.suppressed

    def __call__(self, outcome: WriteOutcome) -> None:
        result = outcome.result
        was_sent = not isinstance(result, Failure) or result.problem in _SENT
        self.counts.count(outcome, was_sent=was_sent)
        if not was_sent and not self._refusals.allows(time.monotonic()):
            if isinstance(result, Failure):
                self._untold[result.problem.value] += 1
            return
        _log(outcome)
        self._tell(outcome.time, payload.write_outcome(outcome), refused=not was_sent)

    def of_transfer(self, outcome: WriteOutcome) -> None:
        """Takes the outcome of a row of transfers, which may write each second for years.

        It is in the log and in history when the row ends in another way than before.
        """
        problem = outcome.result.problem if isinstance(outcome.result, Failure) else None
        was_sent = problem is None or problem in _SENT
        self.counts.count(outcome, was_sent=was_sent)
        data = payload.write_outcome(outcome)
        if outcome.by not in self._ends or self._ends[outcome.by] is not problem:
            self._ends[outcome.by] = problem
            _log(outcome)
            self._tell(outcome.time, data, refused=not was_sent)
        elif was_sent:
            self._publish(data)

    def report_suppressed(self) -> None:
        """Summarises the refusals suppressed since the previous call, if there are any."""
        if count := self._refusals.newly_suppressed():
            kinds, self._untold = dict(self._untold), Counter()
            log.warning("refusals suppressed", count=count, kinds=kinds)
            now = time.time_ns()
            time_text = rfc3339(now)
            summary = {"outcome": "suppressed", "count": count, "kinds": kinds, "time": time_text}
            self._tell(now, payload.document(summary), refused=True)

    def _tell(self, at: int, data: bytes, *, refused: bool) -> None:
        self._publish(data)
        if self._record is not None:
            self._record(at, data.decode(), refused=refused)


def _log(outcome: WriteOutcome) -> None:
    fields = {
        # Key and value come from the client, and may be of any length.
        "key": payload.short(outcome.key),
        "value": payload.loggable(outcome.value),
        "took": round(outcome.took, 4),
        "by": outcome.by,
    }
    match outcome.result:
        case WriteResult(verified=verified):
            log.info(audited.WRITTEN, verified=verified, **fields)
        case CommandResult(answer):
            log.info(audited.EXECUTED, answer=answer, **fields)
        case Failure(problem, reason, code):
            log.warning(
                _FAILURE_EVENTS[outcome.command, problem is Problem.UNCLEAR],
                error=problem.value,
                code=code,
                reason=payload.short(reason),
                **fields,
            )
