"""The status documents on their keys: built for queries, and published regularly."""

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from gateway.contract import payload
from gateway.contract.keys import Keys
from gateway.northbound.publishing.publisher import Publisher
from gateway.northbound.requests.audit import Audit

# A collection is followed by a pause of so many times its duration. Queries of this time wait for
# the next one together, so that they take at most a tenth of the loop.
_PAUSE = 9.0


@dataclass(eq=False)
class StatusPublisher:
    """Publishes every document, and reports suppressed refusals, every `every` seconds."""

    _keys: Keys
    _collect: Callable[[], Mapping[str, Mapping[str, object]]]  # the current documents by path
    _publisher: Publisher
    _audit: Audit
    _every: float
    _clock: Callable[[], float] = time.monotonic
    _collected_at: float = float("-inf")
    _pause_until: float = float("-inf")
    _fields: Mapping[str, Mapping[str, object]] = field(default_factory=dict)  # by path
    _documents: dict[str, bytes] = field(default_factory=dict)  # by key

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
        await self._collected_since(self._clock())
        return self._documents

    async def fields(self, max_age: float) -> Mapping[str, Mapping[str, object]]:
        """Returns the fields of every document by its path, at most `max_age` seconds old at the
        time of the call."""
        await self._collected_since(self._clock() - max_age)
        return self._fields

    async def _collected_since(self, called: float) -> None:
        while self._collected_at < called:
            if (pause := self._pause_until - self._clock()) > 0:
                await asyncio.sleep(pause)
            else:
                self._build()

    def _build(self) -> None:
        self._collected_at = self._clock()
        self._fields = self._collect()
        self._documents = {
            self._keys.status(path): payload.document(fields)
            for path, fields in self._fields.items()
        }
        ended = self._clock()
        self._pause_until = ended + _PAUSE * (ended - self._collected_at)
