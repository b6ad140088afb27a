"""The time on one line: when its wire was last busy, and one timer for all its time-outs."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

NEVER = float("inf")


def loop_time() -> float:
    return asyncio.get_running_loop().time()


class Alarm:
    """One timer for one time-out after another, of which hardly any is ever reached.

    To arm a timer and take it back costs more than all else there is to a question. So this one
    is left running, and who waits is looked up when it goes off.
    """

    __slots__ = ("_due", "_look", "_timer")

    def __init__(self) -> None:
        self._due = NEVER  # when the timer goes off
        self._look: Callable[[], float] = lambda: NEVER
        self._timer: asyncio.TimerHandle | None = None

    def by(self, when: float, look: Callable[[], float]) -> None:
        """Call `look` at `when` or before, and nobody else any more. It says when to come again."""
        self._look = look
        if when < self._due:
            if self._timer is not None:
                self._timer.cancel()
            self._due = when
            self._timer = asyncio.get_running_loop().call_at(when, self._off)

    def _off(self) -> None:
        self._due, self._timer = NEVER, None
        again = self._look()
        if again < NEVER:
            self.by(again, self._look)


@dataclass(slots=True)
class Clock:
    """When the wire was last busy; shared by all turns of a line.

    Event loops round sleeps up by about a millisecond. On a fast line the last `spin` seconds
    of a silence are therefore waited for by looking at the clock.
    """

    quiet_since: float = 0.0
    spin: float = 0.0
    now: Callable[[], float] = loop_time
    alarm: Alarm = field(default_factory=Alarm)
