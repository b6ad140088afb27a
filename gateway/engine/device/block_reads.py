"""The good reads of one block: the last one, and counts since it was planned."""

from collections.abc import Sequence
from dataclasses import dataclass

from gateway.planning.planner import Block
from gateway.tags import Sample
from gateway.tags.scan import Scan


@dataclass(slots=True)
class BlockReads:
    """The last good read of a block, and counts. Times in seconds of the line's clock."""

    at: float | None = None  # the last one; None: the block's values are bad
    ever: bool = False  # the block was read at least once
    scan: Scan | None = None  # the next read is compared with it; None: with nothing
    count: int = 0  # good ones since it was planned
    overruns: int = 0  # rounds that were skipped because the one before was late
    mean_gap: float = 0.0  # between two good reads, smoothed over about ten
    worst_gap: float = 0.0

    def take(self, block: Block, units: Sequence[int], now: float, time: int) -> Sequence[Sample]:
        """Returns the samples of a good read. Only units that changed are decoded."""
        if self.at is not None:
            gap = now - self.at
            if gap > self.worst_gap:
                self.worst_gap = gap
            self.mean_gap += (gap - self.mean_gap) / (min(10, self.count) or 1)
        self.count += 1
        self.at, self.ever = now, True
        if block.of_fields:
            return block.decoder.fields(units, time)
        scan = self.scan
        if scan is None or scan.latest.superseded:
            scan = self.scan = block.decoder.first(units, time)
        elif units == scan.units:
            scan.time = time
        else:
            scan = self.scan = block.decoder.after(scan, units, time)
        return scan

    def forget(self, now: float) -> float:
        """Forgets the last read, because its values turn bad. Returns their age."""
        age = 0.0 if self.at is None else now - self.at
        self.worst_gap = max(self.worst_gap, age)
        self.at = self.scan = None
        return age

    def restart(self) -> None:
        """Forgets when the last read was: the device comes online with other values."""
        self.at = None

    def compare_with_nothing(self) -> None:
        """Has all units of the next read decoded."""
        self.scan = None

    def count_overruns(self, missed: int) -> None:
        self.overruns += missed
