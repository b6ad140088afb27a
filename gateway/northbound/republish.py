"""Publishes samples again that subscribers may have missed.

All values after a link has returned, because Zenoh stores nothing; bad values with their heartbeat.
Good values are repeated as they are read. A value of an event tag is published once; only its bad
quality is published again, as for other tags.
"""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress

from gateway.northbound.interfaces import Plant
from gateway.northbound.link_monitor import LinkMonitor
from gateway.northbound.tag_index import TagIndex
from gateway.tags import Quality, Sample, Tag

# After a link returned, its declarations arrive first; only then does a put reach a subscriber.
_SETTLE_TIME = 0.3
# Other clients of a restarted router may reconnect later than this gateway: publish again.
_LATE_CLIENTS = 5.0
_BATCH_SIZE = 500  # samples in one turn of the loop
_HEARTBEAT_CHECK = 1.0  # seconds: a heartbeat may be this late


class Republisher:
    """Publishes everything in small batches, so that the event loop stays responsive."""

    def __init__(
        self,
        publish: Callable[[Sequence[Sample]], None],
        plant: Plant,
        index: TagIndex,
        links: LinkMonitor,
    ) -> None:
        self._publish = publish
        self._plant = plant
        self._index = index
        self._links = links

    async def publish_all(self) -> None:
        tags = self._index.tags
        for start in range(0, len(tags), _BATCH_SIZE):
            current = [self._plant.sample(tag) for tag in tags[start : start + _BATCH_SIZE]]
            again = [s for s in current if not s.tag.event or s.quality is Quality.BAD]
            self._plant.mark_published(again)
            self._publish(again)
            await asyncio.sleep(0)

    async def run(self) -> None:
        """Runs until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._after_returned_links())
            tasks.create_task(self._heartbeats())

    async def _after_returned_links(self) -> None:
        returned = self._links.returned
        while True:
            await returned.wait()
            await asyncio.sleep(_SETTLE_TIME)
            returned.clear()
            await self.publish_all()
            with suppress(TimeoutError):
                async with asyncio.timeout(_LATE_CLIENTS):
                    await returned.wait()
                    continue
            await self.publish_all()

    async def _heartbeats(self) -> None:
        tags = [tag for tag in self._index.tags if tag.heartbeat]
        published_at: dict[Tag, float] = {}  # of bad samples, by the loop's clock
        while tags:
            await asyncio.sleep(_HEARTBEAT_CHECK)
            for start in range(0, len(tags), _BATCH_SIZE):
                self._publish(self._due(tags[start : start + _BATCH_SIZE], published_at))
                await asyncio.sleep(0)

    def _due(self, tags: list[Tag], published_at: dict[Tag, float]) -> list[Sample]:
        now, due = asyncio.get_running_loop().time(), []
        for tag in tags:
            sample = self._plant.sample(tag)
            if sample.quality is Quality.GOOD:
                published_at.pop(tag, None)
            elif now - published_at.setdefault(tag, now) >= (tag.heartbeat or 0.0):
                published_at[tag] = now
                due.append(sample)
        return due
