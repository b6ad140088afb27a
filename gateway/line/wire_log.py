"""The wire log: every byte and every job of a line, for those who watch it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from gateway.engine.jobs.jobs import Result, Transacted
from gateway.tags import Sample


class Piece(NamedTuple):
    """Bytes that were sent (`>`) or received (`<`) together."""

    way: str
    data: bytes


class Performed(NamedTuple):
    """A job with its result, and the times of its begin and end by the line's clock."""

    job: Transacted
    result: Result
    begun: float
    ended: float


class Learned(NamedTuple):
    """Samples of bytes that were received without a request of this gateway."""

    samples: Sequence[Sample]


Event = Piece | Performed | Learned
Listener = Callable[[Event], None]


class WireLog:
    """Passes the bytes and the jobs of one line to its listeners."""

    __slots__ = ("_listeners", "active")

    def __init__(self) -> None:
        self._listeners: list[Listener] = []
        self.active = False  # an inactive log costs no time

    def listen(self, listener: Listener) -> None:
        self._listeners.append(listener)
        self.active = True

    def forget(self, listener: Listener) -> None:
        """Removes a listener; one that is not there is no mistake."""
        self._listeners = [one for one in self._listeners if one != listener]
        self.active = bool(self._listeners)

    def sent(self, data: bytes) -> None:
        self._pass_on(Piece(">", data))

    def heard(self, data: bytes) -> None:
        self._pass_on(Piece("<", data))

    def performed(self, job: Transacted, result: Result, begun: float, ended: float) -> None:
        self._pass_on(Performed(job, result, begun, ended))

    def learned(self, samples: Sequence[Sample]) -> None:
        self._pass_on(Learned(samples))

    def _pass_on(self, event: Event) -> None:
        for listener in self._listeners:
            listener(event)
