"""The job of a line that is handed out and not yet concluded."""

from dataclasses import dataclass, field

from gateway.engine.device import Device
from gateway.engine.jobs import Confirm, Poll, Repeat, Transacted
from gateway.errors import DeviceError


@dataclass(slots=True)
class InFlight:
    """The job that was handed out, and what follows it before any other."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    charged: Device | None = None  # pays for the time: a poll in its turn, or a probe
    open_polls: int = 0
    failed: list[tuple[Poll, DeviceError]] = field(default_factory=list)
    continuation: Transacted | None = None

    def resume(self, now: float) -> Transacted:
        """Hands out the continuation. What confirms or repeats a write has its own time."""
        job, self.continuation = self.continuation, None
        if job is None:
            raise AssertionError("nothing follows")
        self.job = job
        if isinstance(job, Confirm | Repeat):
            self.begun = now
        return job
