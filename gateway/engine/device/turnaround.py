"""The turnaround of a station that plans and forecasts expect."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.engine.device.records import Record

LEARN_EVERY = 50  # requests between two comparisons with the measured turnaround
# Seconds: plans expect no shorter one. Less wire time than this is not worth another request, nor
# a new plan while the times of a fast network vary.
SHORTEST = 0.001
SMOOTHED = 0.99  # of the longest poll, for each one after it
SLOW, AS_PLANNED = 1.0, 0.5  # of a poll, that a turnaround is longer than planned
MOST_PATIENCE = 128  # times LEARN_EVERY, between two plans that change nothing


@dataclass(slots=True)
class Turnaround:
    """The turnaround of a station that plans and forecasts expect. Seconds."""

    configured: float | None
    expected: float | None = field(init=False)  # None: the default of the protocol
    norm: float | None = field(init=False)  # of the file, or of the first replies; None: too few
    planned_poll: float = math.inf  # of the longest poll, with that one,
    planned_load: float = 0.0  # and the share of the wire of all polls
    slow_from: float = math.inf  # a longer turnaround is as long as a whole poll,
    slow_to: float = math.inf  # or no longer than half of one
    slow: float = 0.0  # of a poll, if the last turnaround was so much longer than the norm
    gives_way: bool = False  # since then it waited while others needed the wire
    look_at: float = LEARN_EVERY  # number of requests at the next comparison with the measured one
    plan_from: int = 0  # number of requests from which on it may be planned again
    _planned: float | None = None  # the one in the last plan; None: the default of the protocol
    _patience: int = 1
    _fewest: float | None = None  # requests a second of any plan; None: not counted yet

    def __post_init__(self) -> None:
        self.expected = self.norm = self.configured
        if self.configured is not None:
            self.look_at = math.inf

    def learn(self, record: Record) -> bool:
        """Expects the measured one from now on. Returns True if the device may be planned again."""
        if record.replies.turnaround is None:
            return False
        self.look_at = record.exchanges + LEARN_EVERY
        self.expected = record.replies.turnaround
        self.norm = self.expected if self.norm is None else self.norm
        return record.exchanges >= self.plan_from

    def change(self, default: float) -> float:
        """Returns the difference to the one in the last plan. `default`: of the protocol."""
        planned = default if self._planned is None else self._planned
        expected = default if self.expected is None else self.expected
        return max(expected, SHORTEST) - max(planned, SHORTEST)

    @property
    def of_plans(self) -> float | None:
        """The one that a plan expects."""
        return None if self.expected is None else max(self.expected, SHORTEST)

    @property
    def milliseconds(self) -> int | None:
        """The expected one in begun milliseconds: worst ages are not calculated again for less."""
        return None if self.expected is None else math.ceil(self.expected * 1000)

    def planned(self, record: Record, *, useful: bool) -> None:
        """Notes a plan with the expected one. The next waits longer if this one was not useful."""
        self._planned = self.expected
        self._patience = 1 if useful else min(2 * self._patience, MOST_PATIENCE)
        self.plan_from = record.exchanges + LEARN_EVERY * self._patience

    def fewest(self, count: Callable[[], float]) -> float:
        """Returns the requests a second that each plan needs. `count`: counts them, once."""
        if self._fewest is None:
            self._fewest = count()
        return self._fewest

    def replied(self, turnaround: float) -> bool:
        """Notes the turnaround of a reply. Returns True if polls take much longer than before."""
        slow = turnaround > (self.slow_to if self.slow else self.slow_from)
        took = self.planned_poll + turnaround
        self.slow = max(took, SMOOTHED * self.slow) if slow else 0.0
        self.gives_way = self.gives_way and slow
        return slow

    def give_way(self) -> None:
        """Notes that its poll waits for those of others."""
        self.gives_way = True

    def replan(self, longest_poll: float, load: float) -> None:
        """Forgets what holds for the tags and addresses of the last plan only.

        `longest_poll`, `load`: seconds of the longest one of the new plan, and the share of the
        wire of all, at the norm.
        """
        self.planned_poll, self.planned_load = longest_poll, load
        if self.norm is not None:
            self.slow_from = self.norm + SLOW * longest_poll
            self.slow_to = self.norm + AS_PLANNED * longest_poll
        self._fewest = None
