"""Line silence: decides that a port through which no reply comes is opened again."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Reopen, Result, Sent, Settled
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import (
    BadValue,
    DeviceError,
    Evidence,
    Garbled,
    LineDown,
    NoReply,
    Unclear,
    Unsteady,
)

NEVER = float("inf")
FIRST, LONGEST = 20.0, 600.0  # seconds without a reply until the port is opened again
SEVERAL = 3  # transactions without a reply; fewer do not show that the line is dead


class LineSilence:
    """The requests of one line since its last reply.

    A session may be open and pass nothing, and a device server may lose its settings: only a new
    session helps. A plant without power is silent too, so the time until the next
    opening doubles until a station replies.
    """

    __slots__ = ("_begun", "_limit", "_requests", "noted")

    def __init__(self) -> None:
        self.noted = False  # a reply would change something
        self._requests = 0  # transactions without a reply
        self._begun = NEVER  # the first of them on the open port
        self._limit = 0.0  # seconds; 0: of the first opening

    def unanswered(self, error: DeviceError, begun: float) -> None:
        """Notes a transaction since `begun` whose requests got no reply."""
        match error:
            case NoReply() | Garbled(evidence=Evidence.NOISE | Evidence.ECHO):
                self.noted = True
                self._requests += 1
                self._begun = min(self._begun, begun)
            case _:
                self.heard()

    def concluded(self, result: Result | Exception) -> None:
        """Takes the result of a job: any reply is a sign of life, a broadcast has none."""
        match result:
            case Unsteady():
                self.heard()
            case Settled(late=None) | Sent(acknowledged=False):
                pass
            case Unclear() | LineDown() | BadValue() | None:
                pass
            case _:
                self.heard()

    def heard(self) -> None:
        """Notes a reply, or another frame."""
        self.noted = False
        self._requests, self._begun, self._limit = 0, NEVER, 0.0

    def opened(self) -> None:
        """Begins the time of a port that was opened."""
        self._begun = NEVER

    @property
    def due(self) -> float:
        """The time to open the port again."""
        return self._begun + (self._limit or FIRST) if self._requests >= SEVERAL else NEVER

    def confirmed(self, schedule: Schedule, devices: Sequence[Device]) -> bool:
        """Returns True if every station failed. Otherwise has one polled that replied last time."""
        for device in devices:
            if device.health.state is State.ONLINE and (polls := schedule.polls(device)):
                schedule.expedite(polls[0])
                return False
        return True

    def reopen(self, now: float) -> Reopen:
        """Returns the job that opens the port again, and doubles the time until the next."""
        requests, silent = self._requests, now - self._begun
        self._limit = min(2 * (self._limit or FIRST), LONGEST)
        return Reopen(
            f"no station has replied for {silent:.0f} s ({requests} requests in all): "
            "the port is opened again"
        )
