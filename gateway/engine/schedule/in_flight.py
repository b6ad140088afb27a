"""The current job of a line, and the job that must follow it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from gateway.engine.device.device import Device
from gateway.engine.device.records import LineRecord, Resyncs
from gateway.engine.jobs.jobs import Confirm, Poll, Probe, ReadBack, Repeat, Transacted
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.errors import DeviceError

MOST_CHARGED = 10.0  # seconds of a transaction: a longer one shows that the process stood still


class HeldRead(NamedTuple):
    """A good read whose values wait for a proof. Times of its reply."""

    poll: PollEntry
    units: Sequence[int]
    now: float
    time: int


@dataclass(slots=True)
class InFlight:
    """The current job of the line, and the job that must follow it."""

    job: Transacted | None = None
    begun: float = 0.0  # by the line's clock
    open: dict[Poll, PollEntry] = field(default_factory=dict)  # polls that are not concluded
    failed: list[tuple[PollEntry, DeviceError]] = field(default_factory=list)
    continuation: Transacted | PollEntry | None = None
    held: list[HeldRead] = field(default_factory=list)  # of one device; one proof is for all
    doubted: bool = False  # an extra reply arrived since the first of them
    owing: Device | None = None  # its next resync is due to a request without a reply

    def stood_still(self, now: float) -> None:
        """Charges the transaction no more than that, whatever time has passed."""
        self.begun = now - MOST_CHARGED

    def follow(self, job: Transacted | PollEntry) -> None:
        """Notes the job that must follow."""
        self.continuation = job

    def owe(self, device: Device) -> None:
        """Notes that a request made a resync necessary."""
        self.owing = device

    def payer(self, probe: Probe, record: LineRecord) -> Device | Resyncs:
        """Returns the account that the seconds of a probe go to."""
        if probe.device is not self.owing:
            return probe.device
        self.owing = None
        return record.resyncs

    def hold(self, read: HeldRead) -> None:
        """Notes a read whose values wait."""
        self.held.append(read)

    def doubt(self) -> None:
        """Notes an extra reply."""
        self.doubted = bool(self.held)

    def doubts(self, device: Device) -> bool:
        """Notes an extra reply of the device. Returns True if reads of it waited."""
        if not self.held or self.held[0].poll.device is not device:
            return False
        self.doubted = True
        return True

    def release(self) -> tuple[Sequence[HeldRead], bool]:
        """Returns the reads whose values waited, once, and True if an extra reply arrived."""
        held, doubted = self.held, self.doubted
        self.held, self.doubted = [], False
        return held, doubted

    def clear(self) -> None:
        """No job is handed out any more."""
        self.job = self.continuation = None
        self.release()
        self.open.clear()
        self.failed.clear()

    def resume(self, now: float, record: LineRecord) -> Transacted:
        """Returns the continuation. All but polls, `Settle` and `Probe` begin their own time."""
        job, self.continuation = self.continuation, None
        if job is None:
            raise AssertionError("no continuation")
        if isinstance(job, PollEntry):
            self.open[job.job] = job
            job = job.job
        self.job = job
        if isinstance(job, ReadBack | Confirm | Repeat):
            record.used(now, self.begun)
            self.begun = now
        return job
