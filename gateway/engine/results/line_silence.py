"""Line silence: decides that a port through which no reply comes is opened again."""

from collections.abc import Sequence
from typing import Any

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.jobs.jobs import Reopen, Result, Sent, Settled, Traffic, Transacted
from gateway.engine.results.rule import NEVER, Rule
from gateway.engine.results.unsolicited import speaks
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import (
    BadValue,
    Busy,
    DeviceError,
    Evidence,
    Garbled,
    LineDown,
    NoReply,
    Refused,
    Unsteady,
)

FIRST, LONGEST = 20.0, 120.0  # seconds without a reply until the port is opened again
SEVERAL = 3  # transactions without a reply; fewer do not show that the line is dead


class LineSilence(Rule):
    """The requests of one line since its last reply.

    A session may be open and pass nothing, and a device server may lose its settings: only a new
    session helps. A plant without power is silent too, so the time until the next
    opening doubles until a station replies.
    """

    always = False

    def __init__(self, schedule: Schedule, devices: Sequence[Device], in_flight: InFlight) -> None:
        self._schedule = schedule
        self._devices = devices
        self._in_flight = in_flight
        self._noted = False  # a reply would change something
        self._requests = 0  # transactions without a reply
        self._begun = NEVER  # the first of them on the open port
        self._limit = 0.0  # seconds; 0: of the first opening

    def first(self, now: float) -> Reopen | None:
        """Returns the job that opens the port again."""
        if self._requests < SEVERAL or self.wake(now) > now or not self._confirmed():
            return None
        requests, silent = self._requests, now - self._begun
        self._limit = min(2 * (self._limit or FIRST), LONGEST)
        return Reopen(
            f"no station has replied for {silent:.0f} s ({requests} requests in all): "
            "the port is opened again"
        )

    def wake(self, now: float) -> float:
        """Returns the time to open the port again."""
        if self._requests < SEVERAL or self._schedule.reaches_by_modem:
            return NEVER
        return self._begun + (self._limit or FIRST)

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Takes the result of a job: any reply is a sign of life, a broadcast has none."""
        match result:
            case Unsteady() | Refused():
                self.heard()
            case DeviceError() if traffic.sent and not job.device.broadcast:
                self._unanswered(result)
            case DeviceError() | LineDown() | BadValue() | Busy() | None:
                pass
            case Settled(late=None) | Sent(acknowledged=False):
                pass
            case _:
                self.heard()

    def _unanswered(self, error: DeviceError) -> None:
        """Notes a transaction whose requests got no reply."""
        if len(self._in_flight.open) > 1:
            return  # of several polls in one transaction, the last one counts
        match error:
            case NoReply() | Garbled(evidence=Evidence.NOISE | Evidence.ECHO):
                self._noted = True
                self._requests += 1
                self._begun = min(self._begun, self._in_flight.begun)
            case _:
                self.heard()

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes of a device that sends unsolicited frames."""
        if self._noted and any(speaks(device) for device in self._devices):
            self.heard()

    def unmatched(self, device: Device, frame: Any, now: float, time: int, *, echo: bool) -> None:
        """Takes a frame that is no reply."""
        if not echo:
            self.heard()

    def heard(self) -> None:
        """Notes a reply, or another frame, also one that arrives too late for its request."""
        if self._noted:
            self._noted = False
            self._requests, self._begun, self._limit = 0, NEVER, 0.0

    def opened(self, now: float) -> None:
        """Begins the time of a port that was opened."""
        self._begun = NEVER

    def _confirmed(self) -> bool:
        """Returns True if every station failed. Otherwise has one polled that replied last time."""
        for device in self._devices:
            if device.health.state is State.ONLINE and (polls := self._schedule.polls(device)):
                self._schedule.expedite(polls[0])
                return False
        return True
