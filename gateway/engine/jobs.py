"""What a line can have to do next."""

from collections.abc import Sequence
from dataclasses import dataclass

from gateway.engine.device import Device
from gateway.engine.requests import Order
from gateway.planning.planner import Block
from gateway.tags import Sample

PAUSE_FIRST = 1.0
PAUSE_LONGEST = 60.0
URGENT, NOWHERE = -1, -2  # tickets of polls that are in no heap


@dataclass(slots=True, eq=False)
class Poll:
    """A block and when it is due. Times in seconds of the loop's clock."""

    device: Device
    block: Block
    due: float
    tries: int = 0
    setbacks: int = 0  # rounds in a row that got no answer, though the device answers otherwise
    last_good: float | None = None  # when it was read last; None: its values are bad
    seen: bool = False  # it was read at least once
    asked: float = 0.0  # when it was handed out last
    hurried: bool = False  # before its turn, as somebody wants to see it
    phased: bool = True  # it has found its place in the period
    live: bool = True  # False once the device was planned anew
    reads: int = 0  # good ones
    overruns: int = 0  # rounds left out because the one before was late
    mean_gap: float = 0.0  # seconds between two good reads, smoothed over about ten
    worst_gap: float = 0.0
    ticket: int = NOWHERE  # its one valid place in the queues
    units: Sequence[int] | None = None  # as they were read last, and
    told: Sequence[Sample] | None = None  # what was told of them

    def read(self, now: float) -> None:
        """Its values have just come."""
        if self.last_good is not None:
            gap = now - self.last_good
            self.worst_gap = max(self.worst_gap, gap)
            self.mean_gap += (gap - self.mean_gap) / max(1, min(10, self.reads))
        self.reads += 1
        self.last_good = now
        self.seen = True

    def forget(self, now: float) -> float:
        """Its values turn bad. Returns how old they were."""
        age = 0.0 if self.last_good is None else now - self.last_good
        self.worst_gap = max(self.worst_gap, age)
        self.last_good = None
        return age

    @property
    def every(self) -> float:
        """How often it is asked: less and less where no answer comes."""
        every = self.device.interval(self.block)
        if self.setbacks:
            every = max(every, min(PAUSE_FIRST * 2.0 ** min(self.setbacks, 10), PAUSE_LONGEST))
        return every

    @property
    def deadline(self) -> float:
        """An address asked for rarely, as it was refused, does not wait as long when it is due."""
        return self.due + self.block.every


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """Ask a device we are in doubt about something harmless."""

    device: Device


@dataclass(frozen=True, slots=True)
class Idle:
    """Nothing to say until then, unless a write comes."""

    until: float


Job = Poll | Order | Probe | Idle
