"""Sorts the samples of a scan by how they are published: values, events, blocks."""

from collections.abc import Sequence

from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing.publisher import Publisher
from gateway.tags import Sample
from gateway.tags.scan import Samples


class ScanBatches:
    """Event loop only; never blocks."""

    def __init__(self, publisher: Publisher, index: TagIndex) -> None:
        self._publisher = publisher
        self._index = index

    def publish(self, samples: Sequence[Sample]) -> None:
        """One call is one scan. Samples of event tags all go out, in order, none replaced."""
        others = self._index.sorted_out
        if not others or (isinstance(samples, Samples) and samples.tags[0].device not in others):
            self._publisher.values(samples)
        else:
            self._sort(samples)

    def _sort(self, samples: Sequence[Sample]) -> None:
        values = samples
        if any(sample.tag.publishing.event for sample in samples):
            self._publisher.events(sample for sample in samples if sample.tag.publishing.event)
            values = [sample for sample in samples if not sample.tag.publishing.event]
        if only_blocks := self._index.only_blocks:
            values = [sample for sample in values if sample.tag.device not in only_blocks]
        self._publisher.values(values)
        with_blocks = self._index.with_blocks
        if not with_blocks:
            return
        scans: dict[str, list[Sample]] = {}
        for sample in samples:
            if sample.tag.device in with_blocks:
                scans.setdefault(sample.tag.device, []).append(sample)
        for device, changed in scans.items():
            self._publisher.block(device, changed)
