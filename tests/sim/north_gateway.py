"""One life of the gateway's program at the simulated northbound edge."""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from gateway.config import Config, LineConfig
from gateway.contract.interfaces import History
from gateway.northbound.northbound import Northbound
from gateway.parts.history.historian import Historian
from gateway.parts.history.settings import HistorySection
from gateway.plant.plant import Plant
from gateway.plant.threads import off_loop
from gateway.tags import Sample
from tests.no_parts import NoParts
from tests.sim.north_judge import Judge

CLOSE_WITHIN = 1.0  # seconds for the history


class Kept(NoParts):
    """A history, and no other part."""

    def __init__(self, kept: History) -> None:
        self._kept = kept

    def history(self) -> History:
        return self._kept


class Process:
    """Lines, Zenoh side and history, connected, started and ended as `service/service.py` does."""

    def __init__(
        self,
        config: Config,
        judge: Judge,
        wall: Callable[[], int],
        opener: Callable[[LineConfig], Any],
    ) -> None:
        self.judge = judge
        self.gateway = Plant(config, wall, opener)
        history = config.part(HistorySection)
        assert history is not None
        self.history = Historian(history.path, history.keep, history.max_size, wall)
        self.northbound = Northbound(config.zenoh, "sim", self.gateway, parts=Kept(self.history))
        self.gateway.subscribe(judge)
        self.gateway.subscribe(self.northbound)
        self.gateway.subscribe(self)
        self.gateway.doors.documents.append(lambda: {"history": self.history.document()})
        self._serving: list[asyncio.Task[None]] = []
        self._lines: list[asyncio.Task[None]] = []

    # From the gateway

    def publish(self, samples: Sequence[Sample]) -> None:
        self.judge.record(samples)
        self.history.record(samples)

    def set_online(self, device: str, online: bool) -> None:
        """History keeps no device states."""

    # The life

    async def start(self) -> None:
        self._serving = [asyncio.create_task(self.northbound.run(), name="northbound")]
        await self.northbound.exclusive.wait()
        self.history.start()
        await self.northbound.admission.active.wait()
        starting = list(self.gateway.mirror.samples())
        self.judge.publish(starting)
        self.publish(starting)
        self._lines = [asyncio.create_task(line.run()) for line in self.gateway.lines]
        await self.northbound.opened.wait()

    async def stop(self) -> None:
        await end(self._lines)
        await end(self._serving)
        if not await off_loop(self.history.close, CLOSE_WITHIN):
            self.judge.broke("the history failed to close in time")

    def look(self) -> None:
        for task in [*self._serving, *self._lines]:
            if task.done():
                self.judge.broke(f"{task.get_name()} failed by itself: {task}")


async def end(tasks: Sequence[asyncio.Task[Any]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
