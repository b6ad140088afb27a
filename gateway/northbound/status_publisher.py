"""The status documents on their keys: built for queries, and published regularly."""

import asyncio
import time
from collections.abc import Callable, Mapping

from gateway.northbound import payload
from gateway.northbound.audit import Audit
from gateway.northbound.keys import Keys
from gateway.northbound.publisher import Publisher

# A collection is followed by a pause of so many times its duration. Queries of this time wait for
# the next one together, so that they take at most a tenth of the loop.
_PAUSE = 9.0


class StatusPublisher:
    """Publishes every document, and reports suppressed refusals, every `every` seconds."""

    def __init__(
        self,
        keys: Keys,
        collect: Callable[[], Mapping[str, Mapping[str, object]]],
        publisher: Publisher,
        audit: Audit,
        every: float,
    ) -> None:
        """`collect` returns the current documents by path."""
        self._keys = keys
        self._collect = collect
        self._publisher = publisher
        self._audit = audit
        self._every = every
        self._clock = time.monotonic
        self._collected_at = float("-inf")
        self._pause_until = float("-inf")
        self._documents: dict[str, bytes] = {}

    async def run(self) -> None:
        """Runs until cancelled."""
        while True:
            await asyncio.sleep(self._every)
            self._audit.report_suppressed()
            self.publish()

    def publish(self) -> None:
        self._build()
        for key, document in self._documents.items():
            self._publisher.document(key, document)

    async def documents(self) -> dict[str, bytes]:
        """Returns every document by its key. None is older than the call."""
        called = self._clock()
        while self._collected_at < called:
            if (pause := self._pause_until - self._clock()) > 0:
                await asyncio.sleep(pause)
            else:
                self._build()
        return self._documents

    def _build(self) -> None:
        self._collected_at = self._clock()
        self._documents = {
            self._keys.status(path): payload.document(fields)
            for path, fields in self._collect().items()
        }
        ended = self._clock()
        self._pause_until = ended + _PAUSE * (ended - self._collected_at)
