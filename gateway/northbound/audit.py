"""Every write and command with its outcome: in the log, on the `writes` key, in history.

A write or command that reached a device, or may have, is always reported: the line limits how
often that happens. Refusals before anything was sent come as fast as a client can send, so beyond
a burst they are only counted.
"""

import time
from collections.abc import Callable

import structlog

from gateway.engine.requests import CommandResult
from gateway.northbound import payload
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.northbound.rate_limit import RateLimit
from gateway.tags import WriteResult

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

BURST = 300  # refusals reported one by one
EVERY = 1.0  # seconds between further ones: 20 MB of log a day at most
_FAILURE_EVENTS = {
    (False, False): "write failed",
    (False, True): "write unclear",
    (True, False): "command failed",
    (True, True): "command unclear",
}
_SENT = frozenset({Problem.UNCLEAR, Problem.REFUSED})


class Audit:
    """Called with every outcome, on the event loop."""

    def __init__(
        self,
        publish: Callable[[bytes], None],
        record: Callable[[int, str], None] | None = None,
    ) -> None:
        """`publish` and `record` get the outcome as JSON, `record` also the time it ended (ns
        since 1970). They must not block."""
        self._publish = publish
        self._record = record
        self._refusals = RateLimit(BURST, EVERY)

    @property
    def suppressed(self) -> int:
        """Refusals that were only counted, since the start."""
        return self._refusals.suppressed

    def __call__(self, outcome: WriteOutcome) -> None:
        result = outcome.result
        was_sent = not isinstance(result, Failure) or result.problem in _SENT
        if not was_sent and not self._refusals.allows(time.monotonic()):
            return
        _log(outcome)
        data = payload.write_outcome(outcome)
        self._publish(data)
        if self._record is not None:
            self._record(outcome.time, data.decode())

    def report_suppressed(self) -> None:
        """Logs the number of refusals suppressed since the previous call, if there are any."""
        if count := self._refusals.newly_suppressed():
            log.warning("refusals suppressed", count=count)


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
            log.info("tag written", verified=verified, **fields)
        case CommandResult(answer):
            log.info("command executed", answer=answer, **fields)
        case Failure(problem, reason, code):
            log.warning(
                _FAILURE_EVENTS[outcome.command, problem is Problem.UNCLEAR],
                error=problem.value,
                code=code,
                reason=payload.short(reason),
                **fields,
            )
