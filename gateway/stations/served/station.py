"""One served station: its data, the presence of its master, and what is counted."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from gateway.errors import NO_TROUBLE, Diagnosis
from gateway.protocols.driver import AnyDriver
from gateway.stations.served.answering import Done
from gateway.stations.served.registers import Registers
from gateway.tags import Reason, Sample, Tag, bad, good
from gateway.values import Value

NEVER = float("inf")


class Presence(StrEnum):
    """The master, as the station sees it."""

    STARTING = "starting"  # no request yet, or none since the last telephone call
    PRESENT = "up"
    SILENT = "silent"  # no request within `stale_after`


@dataclass(slots=True)
class Counts:
    """Since the start."""

    requests: int = 0
    writes: int = 0  # that were carried out
    refusals: Counter[str] = field(default_factory=Counter)  # by code
    last: float | None = None  # the time of the last request, by the line's clock


@dataclass(slots=True, eq=False)
class ServedStation:
    """Synchronous; every change of its tags and of its presence is a result."""

    name: str
    driver: AnyDriver
    registers: Registers
    counts: Counts = field(default_factory=Counts)
    presence: Presence = Presence.STARTING
    _due: float = NEVER  # when the master is silent
    _trouble: str = ""  # why the wire is lost

    @property
    def stale_after(self) -> float:
        return self.registers.served.stale_after

    @property
    def due(self) -> float:
        """The time when the master counts as silent, unless it sends a request."""
        return self._due

    def opened(self, now: float) -> None:
        """Notes that the wire is open."""
        self._due, self._trouble = now + self.stale_after, ""

    def asked(self, done: Done, now: float, at: int) -> list[Sample]:
        """Notes a request. `at`: its arrival, ns since 1970. Returns the written samples."""
        self.counts.requests += 1
        self.counts.last = now
        if done.refused:
            self.counts.refusals[done.refused] += 1
        elif done.write:
            self.counts.writes += 1
        self.presence = Presence.PRESENT
        self._due = now + self.stale_after
        return [_sample(tag, value, at) for tag, value in done.written]

    def call_ended(self) -> bool:
        """Notes the end of a telephone call: the values stay. Returns True if the master goes."""
        was, self.presence = self.presence, Presence.STARTING
        return was is Presence.PRESENT

    def expire(self, now: float, at: int) -> Sequence[Sample]:
        """Returns bad samples of what the master writes, if it is silent from now on."""
        if now < self._due:
            return ()
        self._due, self.presence = NEVER, Presence.SILENT
        return self._bad(Reason.NO_REPLY, at, self.diagnosed().text)

    def lost(self, at: int, why: str) -> Sequence[Sample]:
        """Returns bad samples of what the master writes: the wire is lost."""
        self._due, self.presence, self._trouble = NEVER, Presence.SILENT, why
        return self._bad(Reason.LINE_DOWN, at, why)

    def _bad(self, reason: Reason, at: int, why: str) -> Sequence[Sample]:
        self.registers.expire()
        return [bad(tag, reason, at, why) for tag in self.registers.written_tags]

    def diagnosed(self) -> Diagnosis:
        """Returns why its master is not there; empty while it is."""
        if self.presence is not Presence.SILENT:
            return NO_TROUBLE
        if self._trouble:
            return Diagnosis("line-down", f"The line is down: {self._trouble}")
        since = "since the start" if self.counts.last is None else f"for {self.stale_after:g} s"
        why = f"The master has sent no request to station {self.driver.station} {since}"
        return Diagnosis("master-silent", why)


def _sample(tag: Tag, value: Value | None, at: int) -> Sample:
    return bad(tag, Reason.NOT_A_NUMBER, at) if value is None else good(tag, value, at)
