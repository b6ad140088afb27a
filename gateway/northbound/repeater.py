"""All current values, again after each return to the network, which keeps nothing."""

import asyncio
from contextlib import suppress

from gateway.northbound.directory import Directory
from gateway.northbound.links import Links
from gateway.northbound.plant import Plant
from gateway.northbound.publisher import Publisher

# After a link returned: first its declarations arrive, and only then does a put reach anyone.
_SETTLE = 0.3
# A router that was restarted gets its other clients back later than us: once more for them.
_LATECOMERS = 5.0
_AT_ONCE = 500  # samples in one turn of the loop


class Repeater:
    """Publishes everything in small pieces, so that the event loop has its turn."""

    def __init__(
        self, publisher: Publisher, plant: Plant, directory: Directory, links: Links
    ) -> None:
        self._publisher = publisher
        self._plant = plant
        self._directory = directory
        self._links = links

    async def publish_all(self) -> None:
        tags = [tag for tag in self._directory.all() if not tag.event]  # an event is told once
        for start in range(0, len(tags), _AT_ONCE):
            chunk = tags[start : start + _AT_ONCE]
            self._publisher.values(self._plant.sample(tag) for tag in chunk)
            await asyncio.sleep(0)

    async def run(self) -> None:
        """Until cancelled."""
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
