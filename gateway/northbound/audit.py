"""Every write and command and what became of it: in the log, on the `writes` key, in history.

What has reached a device, or may have, is always told: the wire itself bounds how often that
happens. What was refused before anything was sent comes as fast as anybody likes, so beyond
a burst it is counted, and told by its number.
"""

import time
from collections.abc import Callable

import structlog

from gateway.engine.requests import CommandResult
from gateway.northbound import payload
from gateway.northbound.limiter import Limiter
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.tags import WriteResult

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

BURST = 300  # refusals told one by one at once
EVERY = 1.0  # seconds for each that follows: 20 MB of log a day at most
_ENDINGS = {
    (False, False): "not written",
    (False, True): "perhaps written",
    (True, False): "command not obeyed",
    (True, True): "command perhaps obeyed",
}
_ON_THE_WIRE = frozenset({Problem.UNCLEAR, Problem.REFUSED})


class Audit:
    """Called with every outcome, on the event loop. `publish` and `record` must not block."""

    def __init__(
        self,
        publish: Callable[[bytes], None],
        record: Callable[[WriteOutcome], None] | None = None,
    ) -> None:
        self._publish = publish
        self._record = record
        self._refusals = Limiter(BURST, EVERY)

    @property
    def untold(self) -> int:
        """Refusals that were only counted, since the start."""
        return self._refusals.held

    def __call__(self, outcome: WriteOutcome) -> None:
        result = outcome.result
        on_the_wire = not isinstance(result, Failure) or result.problem in _ON_THE_WIRE
        if not on_the_wire and not self._refusals.allows(time.monotonic()):
            return
        _log(outcome)
        self._publish(payload.write_outcome(outcome))
        if self._record is not None:
            self._record(outcome)

    def tell_rest(self) -> None:
        """To be called now and again."""
        if count := self._refusals.untold():
            log.warning(
                "more writes and commands were refused than are told one by one", count=count
            )


def _log(outcome: WriteOutcome) -> None:
    shown = {
        # Both come from outside, and may be as long as they like.
        "key": payload.short(outcome.key),
        "value": payload.shown(outcome.value),
        "took": round(outcome.took, 4),
        "by": outcome.by,
    }
    match outcome.result:
        case WriteResult(verified=verified):
            log.info("written", verified=verified, **shown)
        case CommandResult(answer):
            log.info("command obeyed", answer=answer, **shown)
        case Failure(problem, reason, code):
            log.warning(
                _ENDINGS[outcome.command, problem is Problem.UNCLEAR],
                error=problem.value,
                code=code,
                reason=payload.short(reason),
                **shown,
            )
