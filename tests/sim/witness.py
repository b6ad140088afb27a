"""Checks every good value against the clock of the stations' memory."""

from collections.abc import Sequence

from gateway.tags import Quality, Sample
from tests.sim.plant import Plant, clock_word


class Witness:
    """Checks every good value against the station's memory during the transaction that read it.

    The memory must hold clock words (`clockwork`).
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.right = 0
        self.wrong: list[tuple[float, str, int]] = []  # when, tag, milliseconds too old
        plant.listeners.append(self.samples)

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            if sample.quality is not Quality.GOOD:
                continue
            value, now = sample.value, sample.time / 1e9  # a proof may have followed the reply
            began = next((at for at, _ in reversed(self.plant.bench.sent) if at < now), 0.0)
            assert isinstance(value, int)
            age = (clock_word(now, sample.tag.address.number) - value) % 65536
            if age <= (now - began) * 1000 + 1:
                self.right += 1
            else:
                self.wrong.append((now, sample.tag.key, age))
