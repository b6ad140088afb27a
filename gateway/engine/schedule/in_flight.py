"""The current job of a line, and the job that must follow it."""

from dataclasses import dataclass, field

from gateway.engine.jobs.jobs import Confirm, Poll, ReadBack, Repeat, Transacted
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.errors import DeviceError


@dataclass(slots=True)
class InFlight:
    """The current job of the line, and the job that must follow it."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    open: dict[Poll, PollEntry] = field(default_factory=dict)  # polls that are not concluded
    failed: list[tuple[PollEntry, DeviceError]] = field(default_factory=list)
    continuation: Transacted | None = None

    def follow(self, job: Transacted) -> None:
        """Notes the job that must follow."""
        self.continuation = job

    def clear(self) -> None:
        """No job is handed out any more."""
        self.job = self.continuation = None
        self.open.clear()
        self.failed.clear()

    def resume(self, now: float) -> Transacted:
        """Returns the continuation. All but `Settle` and `Probe` begin their own time."""
        job, self.continuation = self.continuation, None
        if job is None:
            raise AssertionError("no continuation")
        self.job = job
        if isinstance(job, ReadBack | Confirm | Repeat):
            self.begun = now
        return job
