"""What is told again: all values after a return to the network, which keeps nothing, and bad
ones with their heartbeat. Good ones are repeated as they are read.

An event is told once; that nothing is known of it is no event, and told like the others."""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress

from gateway.northbound.directory import Directory
from gateway.northbound.links import Links
from gateway.northbound.plant import Plant
from gateway.tags import Quality, Sample, Tag

# After a link returned: first its declarations arrive, and only then does a put reach anyone.
_SETTLE = 0.3
# A router that was restarted gets its other clients back later than us: once more for them.
_LATECOMERS = 5.0
_AT_ONCE = 500  # samples in one turn of the loop
_LOOK_EVERY = 1.0  # seconds: a heartbeat may be so late


class Repeater:
    """Publishes everything in small pieces, so that the event loop has its turn."""

    def __init__(
        self,
        publish: Callable[[Sequence[Sample]], None],
        plant: Plant,
        directory: Directory,
        links: Links,
    ) -> None:
        self._publish = publish
        self._plant = plant
        self._directory = directory
        self._links = links

    async def publish_all(self) -> None:
        tags = self._directory.all()
        for start in range(0, len(tags), _AT_ONCE):
            known = [self._plant.sample(tag) for tag in tags[start : start + _AT_ONCE]]
            again = [s for s in known if not s.tag.event or s.quality is Quality.BAD]
            self._plant.told(again)
            self._publish(again)
            await asyncio.sleep(0)

    async def run(self) -> None:
        """Until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._after_returns())
            tasks.create_task(self._beat())

    async def _after_returns(self) -> None:
        returned = self._links.returned
        while True:
            await returned.wait()
            await asyncio.sleep(_SETTLE)
            returned.clear()
            await self.publish_all()
            with suppress(TimeoutError):
                async with asyncio.timeout(_LATECOMERS):
                    await returned.wait()
                    continue
            await self.publish_all()

    async def _beat(self) -> None:
        tags = [tag for tag in self._directory.all() if tag.heartbeat]
        told: dict[Tag, float] = {}  # when each bad value was, by the loop's clock
        while tags:
            await asyncio.sleep(_LOOK_EVERY)
            for start in range(0, len(tags), _AT_ONCE):
                self._publish(self._due(tags[start : start + _AT_ONCE], told))
                await asyncio.sleep(0)

    def _due(self, tags: list[Tag], told: dict[Tag, float]) -> list[Sample]:
        now, due = asyncio.get_running_loop().time(), []
        for tag in tags:
            sample = self._plant.sample(tag)
            if sample.quality is Quality.GOOD:
                told.pop(tag, None)
            elif now - told.setdefault(tag, now) >= (tag.heartbeat or 0.0):
                told[tag] = now
                due.append(sample)
        return due
