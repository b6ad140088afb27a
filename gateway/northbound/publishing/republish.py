"""Publishes samples again that subscribers may have missed.

All values after a link has returned, because Zenoh stores nothing; values that a full link may have
dropped; every value once per `refresh`, which bounds any other loss; bad values with their
heartbeat. Good values are repeated as they are read. A value of an event tag is published once;
only its bad quality is published again, as for other tags.
"""

import asyncio
import math
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress

from gateway.contract.interfaces import Plant
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.northbound.session.link_monitor import LinkMonitor
from gateway.tags import Quality, Sample, Tag

# After a link returned, its declarations arrive first; only then does a put reach a subscriber.
_SETTLE_TIME = 0.3
# Other clients of a restarted router may reconnect later than this gateway: publish again.
_LATE_CLIENTS = 5.0
# A link that flaps makes the gateway publish everything at growing pauses, until it is calm.
_LONGEST_PAUSE, _CALM = 30.0, 60.0  # seconds
_NEVER = float("-inf")
_BATCH_SIZE = 500  # samples in one turn of the loop
_HEARTBEAT_CHECK = 1.0  # seconds: a heartbeat may be this late
_LOSS_CHECK = 0.5  # seconds
_DOCUMENTS_AFTER = 2.0  # seconds from the last put that found a link full
# Few at a time: a burst would fill a narrow link again.
_FEW, _FEW_EVERY = 100, 0.02  # samples, seconds
_REFRESH_EVERY = 0.2  # seconds, where many tags are refreshed


class Republisher:
    """Publishes everything in small batches, so that the event loop stays responsive."""

    def __init__(
        self,
        publish: Callable[[Sequence[Sample]], None],
        plant: Plant,
        index: TagIndex,
        links: LinkMonitor,
        losses: SlowPuts,
        refresh: float,
        parts: Callable[[], Awaitable[None]],
    ) -> None:
        """`refresh`: seconds in which every tag is published at least once. `parts` publishes
        the documents of the parts."""
        self._publish = publish
        self._plant = plant
        self._index = index
        self._links = links
        self._losses = losses
        self._refresh = refresh
        self._parts = parts

    async def publish_all(self) -> None:
        tags = self._index.tags
        for start in range(0, len(tags), _BATCH_SIZE):
            self._publish_again(tags[start : start + _BATCH_SIZE])
            await asyncio.sleep(0)
        await self._parts()

    def _publish_again(self, tags: Sequence[Tag]) -> None:
        # A reload may have removed a tag meanwhile, or replaced it.
        known = (self._plant.tag(tag.key) for tag in tags)
        current = [self._plant.sample(tag) for tag in known if tag is not None]
        again = [s for s in current if not s.tag.publishing.event or s.quality is Quality.BAD]
        self._plant.mark_published(again)
        self._publish(again)

    async def run(self) -> None:
        """Runs until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._after_returned_links())
            tasks.create_task(self._heartbeats())
            tasks.create_task(self._lost_values())
            tasks.create_task(self._refreshes())
            tasks.create_task(self._lost_documents())

    async def _after_returned_links(self) -> None:
        returned, pause, last = self._links.returned, _SETTLE_TIME, _NEVER
        while True:
            await returned.wait()
            pause = min(2 * pause, _LONGEST_PAUSE) if _now() - last < _CALM else _SETTLE_TIME
            await asyncio.sleep(pause)
            returned.clear()
            await self.publish_all()
            last = _now()
            with suppress(TimeoutError):
                async with asyncio.timeout(_LATE_CLIENTS):
                    await returned.wait()
                    continue
            await self.publish_all()

    async def _lost_values(self) -> None:
        while True:
            await asyncio.sleep(_LOSS_CHECK)
            keys, congested = self._losses.due(_now()), self._losses.congested
            for start in range(0, len(keys), _FEW):
                if self._losses.congested > congested:
                    break  # the link is full again: the rest waits for the next round
                found = map(self._index.tag_at, keys[start : start + _FEW])
                self._publish_again([tag for tag in found if tag is not None])
                await asyncio.sleep(_FEW_EVERY)

    async def _lost_documents(self) -> None:
        """Publishes those of the parts once per `refresh`, and some time after a link was full."""
        full, due = self._losses.congested, _now() + self._refresh
        while True:
            await asyncio.sleep(_LOSS_CHECK)
            if (now_full := self._losses.congested) > full:
                full, due = now_full, _now() + _DOCUMENTS_AFTER
            elif _now() >= due:
                due = _now() + self._refresh
                await self._parts()

    async def _refreshes(self) -> None:
        """Publishes the tags in turn, evenly over the time of `refresh`."""
        due = _now()
        while True:
            tags = self._index.tags
            few = max(1, math.ceil(len(tags) * _REFRESH_EVERY / self._refresh))
            pause = self._refresh * few / max(1, len(tags))
            for start in range(0, max(1, len(tags)), few):
                due += pause
                await asyncio.sleep(due - _now())
                self._publish_again(tags[start : start + few])

    async def _heartbeats(self) -> None:
        known: Sequence[Tag] = ()
        tags: list[Tag] = []
        published_at: dict[Tag, float] = {}  # of bad samples, by the loop's clock
        while True:
            if known is not self._index.tags:
                known = self._index.tags
                tags = [tag for tag in known if tag.publishing.heartbeat]
                published_at = {tag: published_at[tag] for tag in tags if tag in published_at}
            await asyncio.sleep(_HEARTBEAT_CHECK)
            for start in range(0, len(tags), _BATCH_SIZE):
                self._publish(self._due(tags[start : start + _BATCH_SIZE], published_at))
                await asyncio.sleep(0)

    def _due(self, tags: list[Tag], published_at: dict[Tag, float]) -> list[Sample]:
        now, due = _now(), []
        for tag in tags:
            if self._plant.tag(tag.key) is not tag:
                continue
            sample = self._plant.sample(tag)
            if sample.quality is not Quality.BAD:
                published_at.pop(tag, None)
            elif now - published_at.setdefault(tag, now) >= (tag.publishing.heartbeat or 0.0):
                published_at[tag] = now
                due.append(sample)
        return due


def _now() -> float:
    return asyncio.get_running_loop().time()
