"""The status documents on their keys: built on demand, cached briefly, published regularly."""

import asyncio
import time
from collections.abc import Callable, Mapping

from gateway.northbound import payload
from gateway.northbound.audit import Audit
from gateway.northbound.keys import Keys
from gateway.northbound.publisher import Publisher

_CACHE_TIME = 0.2  # seconds: many queries at once cost one collection


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
        self._collected_at = float("-inf")
        self._documents: dict[str, bytes] = {}

    async def run(self) -> None:
        """Runs until cancelled."""
        while True:
            await asyncio.sleep(self._every)
            self._audit.report_suppressed()
            self.publish()

    def publish(self) -> None:
        for key, document in self.documents().items():
            self._publisher.document(key, document)

    def documents(self) -> dict[str, bytes]:
        """Every document by its key; at most 0.2 s old."""
        now = time.monotonic()
        if now - self._collected_at > _CACHE_TIME:
            self._collected_at = now
            self._documents = {
                self._keys.status(path): payload.document(fields)
                for path, fields in self._collect().items()
            }
        return self._documents
