"""Samples of a repeated read with equal values: only their time changes."""

from collections.abc import Sequence
from typing import overload

from gateway.tags import Quality, Sample


class Unchanged(Sequence[Sample]):
    """The samples of a block whose units are the same at every read.

    `time` (nanoseconds since 1970) is the latest read; each read moves it and creates no samples.
    Access to an element creates a sample with that time. `superseded` becomes True when another
    sample of one of the tags arrives; the object is not used after that.
    """

    __slots__ = ("samples", "superseded", "time")

    def __init__(self, samples: Sequence[Sample], time: int) -> None:
        self.samples = samples
        self.time = time
        self.superseded = False

    def restamped(self, sample: Sample) -> Sample:
        """Returns the sample with the latest time. A bad one keeps the time it became bad."""
        return sample._replace(time=self.time) if sample.quality is Quality.GOOD else sample

    def __len__(self) -> int:
        return len(self.samples)

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        if isinstance(index, slice):
            return [self.restamped(sample) for sample in self.samples[index]]
        return self.restamped(self.samples[index])
