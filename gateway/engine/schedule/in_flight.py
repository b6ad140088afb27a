"""The current job of a line, and the job that must follow it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Confirm, Poll, ReadBack, Repeat, Transacted
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.errors import DeviceError


@dataclass(slots=True)
class HeldRead:
    """A good read whose values wait for a proof. Times of its reply."""

    poll: PollEntry
    units: Sequence[int]
    now: float
    time: int
    doubted: bool = False  # an extra reply arrived since

    def doubt(self) -> None:
        """Notes an extra reply."""
        self.doubted = True


@dataclass(slots=True)
class InFlight:
    """The current job of the line, and the job that must follow it."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    open: dict[Poll, PollEntry] = field(default_factory=dict)  # polls that are not concluded
    failed: list[tuple[PollEntry, DeviceError]] = field(default_factory=list)
    continuation: Transacted | None = None
    held: HeldRead | None = None  # its proof is under way

    def follow(self, job: Transacted) -> None:
        """Notes the job that must follow."""
        self.continuation = job

    def hold(self, read: HeldRead) -> None:
        """Notes a read whose values wait."""
        self.held = read

    def doubts(self, device: Device) -> bool:
        """Notes an extra reply of the device. Returns True if one of its reads waited."""
        if self.held is None or self.held.poll.device is not device:
            return False
        self.held.doubt()
        return True

    def release(self) -> HeldRead | None:
        """Returns the read whose values waited, once."""
        held, self.held = self.held, None
        return held

    def clear(self) -> None:
        """No job is handed out any more."""
        self.job = self.continuation = self.held = None
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
