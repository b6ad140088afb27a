"""What was read together on its way out: value by value, in one block, or both."""

from collections.abc import Iterable, Sequence

from gateway.northbound.plant import Device
from gateway.northbound.publisher import Publisher
from gateway.tags import Sample


class Scans:
    """Sorts samples by how they are published. Event loop only; nothing blocks."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self.with_blocks: frozenset[str] = frozenset()
        self._only_blocks: frozenset[str] = frozenset()

    def of(self, devices: Iterable[Device]) -> None:
        """To be called before the session opens: until then nothing goes out."""
        says = {device.name: device.blocks for device in devices}
        self.with_blocks = frozenset(name for name, blocks in says.items() if blocks)
        self._only_blocks = frozenset(name for name, blocks in says.items() if blocks == "only")

    def publish(self, samples: Sequence[Sample]) -> None:
        """One call is one scan. Those of event tags all go out, in order, none replaced."""
        values = samples
        if any(sample.tag.event for sample in samples):
            self._publisher.events(sample for sample in samples if sample.tag.event)
            values = [sample for sample in samples if not sample.tag.event]
        if self._only_blocks:
            values = [sample for sample in values if sample.tag.device not in self._only_blocks]
        self._publisher.values(values)
        if not self.with_blocks:
            return
        scans: dict[str, list[Sample]] = {}
        for sample in samples:
            if sample.tag.device in self.with_blocks:
                scans.setdefault(sample.tag.device, []).append(sample)
        for device, changed in scans.items():
            self._publisher.block(device, changed)
