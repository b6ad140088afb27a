"""Status documents: those of now, however many clients query them."""

import asyncio
import json
import time
from collections.abc import Mapping

from gateway.contract.keys import Keys
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing.publisher import Publisher
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.northbound.publishing.status_publisher import StatusPublisher
from gateway.northbound.requests.audit import Audit

KEYS = Keys("plant", "demo")


class Plant:
    """Counts how often its state was collected, which takes `seconds`."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.state = self.collected = 0
        self._seconds = seconds

    def collect(self) -> Mapping[str, Mapping[str, object]]:
        self.collected += 1
        until = time.monotonic() + self._seconds
        while time.monotonic() < until:
            pass
        return {"status": {"state": self.state}}


def published(plant: Plant) -> StatusPublisher:
    publisher = Publisher(SlowPuts(0.05), TagIndex(KEYS, (), lambda _key: None))
    return StatusPublisher(KEYS, plant.collect, publisher, Audit(lambda _: None), 5.0)


async def test_a_query_is_answered_with_the_state_of_now() -> None:
    plant = Plant()
    status = published(plant)
    for plant.state in range(20):
        found = await status.documents()
        assert json.loads(found["plant/@gateway/demo/status"]) == {"state": plant.state}


async def test_many_queries_at_once_cost_two_collections() -> None:
    plant = Plant(0.05)  # so long that no slow machine takes as long for the queries
    status = published(plant)
    await asyncio.gather(*(status.documents() for _ in range(500)))
    assert plant.collected == 2
