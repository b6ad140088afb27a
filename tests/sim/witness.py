"""Checks every good value against the clock of the stations' memory."""

import asyncio
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
        now = asyncio.get_running_loop().time()
        began = self.plant.bench.sent[-1][0] if self.plant.bench.sent else 0.0
        for sample in samples:
            if sample.quality is not Quality.GOOD:
                continue
            value = sample.value
            assert isinstance(value, int)
            age = (clock_word(now, sample.tag.address.number) - value) % 65536
            if age <= (now - began) * 1000 + 1:
                self.right += 1
            else:
                self.wrong.append((now, sample.tag.key, age))
