"""The current job of a line, and the job that must follow it."""

from dataclasses import dataclass, field

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Confirm, Poll, ReadBack, Repeat, Transacted
from gateway.engine.schedule.poll_entry import PollEntry
from gateway.errors import DeviceError


@dataclass(slots=True)
class InFlight:
    """The current job of the line, and the job that must follow it."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    charged: Device | None = None  # its use of the wire grows: by polls that were due, and probes
    open: dict[Poll, PollEntry] = field(default_factory=dict)  # polls that are not concluded
    together: int = 0  # polls of the transaction
    failed: list[tuple[PollEntry, DeviceError]] = field(default_factory=list)
    continuation: Transacted | None = None

    def begin(self, job: Transacted, now: float, charged: Device | None) -> None:
        """Begins a job that is no poll."""
        self.job, self.begun, self.charged = job, now, charged

    def begin_poll(self, entry: PollEntry, now: float) -> Poll:
        """Begins a poll, and returns the job of the line."""
        job = self.job = entry.job
        self.begun, self.together = now, 1
        self.charged = None if entry.expedited else entry.device
        self.open[job] = entry
        return job

    def begin_beside(self, entry: PollEntry) -> Poll:
        """Begins one more poll in the same transaction."""
        self.open[entry.job] = entry
        self.together += 1
        return entry.job

    def follow(self, job: Transacted) -> None:
        """Notes the job that must follow."""
        self.continuation = job

    def ended(self, now: float, *, shared: bool) -> None:
        """Notes that the job has ended. On a line that is shared, its device used the wire."""
        self.job = None
        self.failed.clear()
        if self.charged is not None and shared:
            self.charged.used(now, self.begun)

    def clear(self) -> None:
        """No job is handed out any more."""
        self.job = self.charged = self.continuation = None
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
