"""A plant of simulated lines on the virtual clock, whose file changes while it runs."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from copy import deepcopy
from typing import Any

from gateway.config import built
from gateway.config.changes import Difference, compare
from gateway.engine.jobs.jobs import Job, Poll
from gateway.parts.transfers.part import with_writes
from gateway.plant.plant import Plant as Gateway
from gateway.service.reload import RunningLines
from gateway.service.reload.renewal import Renewal
from gateway.tags import Quality, Sample
from tests.parts.made import parts_of

Data = dict[str, Any]


def vigor(station: int, **tags: Mapping[str, object]) -> Data:
    tags = tags or {"level": {"address": "D10"}, "recipe": {"address": "D500", "write": True}}
    return {"protocol": "vigor", "station": station, "tags": deepcopy(tags)}


def file(**lines: Mapping[str, Data]) -> Data:
    """Returns the data of a file: devices by name, by line."""
    return {
        "gateway": {"name": "demo"},
        "zenoh": {"prefix": "plant"},
        "lines": {
            line: {"port": "simulator", "baudrate": 19200, "devices": dict(devices)}
            for line, devices in lines.items()
        },
    }


class Plant:
    """A running gateway, and everything that it published."""

    def __init__(self, data: Data) -> None:
        self.data = data
        self.gateway = Gateway(built(data), wall=self._wall)
        self.gateway.subscribe(self)
        self.parts = parts_of(self.gateway, "alarms")
        self.gateway.adjust_forecasts(with_writes)
        self.lines = RunningLines()
        self.published: list[Sample] = []
        self.online: list[tuple[str, bool]] = []

    def _wall(self) -> int:
        return 1_700_000_000_000_000_000 + int(asyncio.get_running_loop().time() * 1e9)

    def publish(self, samples: Sequence[Sample]) -> None:
        self.published += samples

    def set_online(self, device: str, online: bool) -> None:
        self.online.append((device, online))

    def sample(self, key: str) -> Sample:
        tag = self.gateway.tag(key)
        assert tag is not None, key
        return self.gateway.sample(tag)

    def of(self, key: str) -> list[Sample]:
        return [sample for sample in self.published if sample.tag.key == key]

    async def until_good(self, *keys: str) -> None:
        async with asyncio.timeout(300):
            while any(self.sample(key).quality is not Quality.GOOD for key in keys):
                await asyncio.sleep(0.001)

    async def reload(self, change: Callable[[Data], object]) -> Difference:
        """Changes the data of the file and takes it over."""
        self.data = deepcopy(self.data)
        change(self.data)
        difference = compare(self.gateway.config, built(self.data))
        self.published.clear()
        await Renewal(self.gateway, self.lines, difference).run()
        await self.parts.take_over(difference.config, difference.renewed)
        return difference

    def polls(self, name: str) -> list[tuple[str, float]]:
        """Returns a list that grows with each poll of the line: device and begin."""
        found: list[tuple[str, float]] = []
        (engine,) = (one.engine for one in self.gateway.lines if one.engine.name == name)
        original = engine.next

        def noted(now: float) -> Job:
            job = original(now)
            if isinstance(job, Poll):
                found.append((job.device.name, now))
            return job

        engine.next = noted  # type: ignore[method-assign]  # it notes
        return found


@asynccontextmanager
async def running(data: Data) -> AsyncIterator[Plant]:
    plant = Plant(data)
    for line in plant.gateway.lines:
        plant.lines.start(line, line.engine.name, line.run())
    try:
        yield plant
    finally:
        await plant.lines.end_all()
