"""Samples that were read once more with the same values: nothing is made but their new time."""

from collections.abc import Sequence
from typing import overload

from gateway.tags import Quality, Sample


class Unchanged(Sequence[Sample]):
    """The samples of a block as they were told, at the `time` of its last reading.

    One reading after another only moves `time` (nanoseconds since 1970), until something else is
    told of one of the tags: then it is `over`. A sample of that time is made for who looks at it.
    """

    __slots__ = ("over", "samples", "time")

    def __init__(self, samples: Sequence[Sample], time: int) -> None:
        self.samples = samples
        self.time = time
        self.over = False

    def now(self, sample: Sample) -> Sample:
        """That one of them, at its time now. A bad one became bad then, not now."""
        return sample._replace(time=self.time) if sample.quality is Quality.GOOD else sample

    def __len__(self) -> int:
        return len(self.samples)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self.now(sample) for sample in self.samples[index]]
        return self.now(self.samples[index])
