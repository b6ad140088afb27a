"""The audit as a part: keeps what others report, and writes it to the disk within a moment."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

import orjson
import structlog

from gateway.contract.documents.requests import AuditNote
from gateway.contract.interfaces import Keyed
from gateway.contract.past import timerange
from gateway.errors import Busy, Unknown, words_of
from gateway.parts.audit.file import AuditFile, Event, read, within
from gateway.plant.part import Core, Kind, Part, Phase
from gateway.plant.threads import off_loop

log = structlog.get_logger("gateway")
MOST_WAITING = 10_000  # records, while the disk fails
BATCH = 1000  # records that are written together
AGAIN_FIRST, AGAIN_LONGEST = 0.5, 5.0  # seconds between two tries of a disk that fails
CLOSE_WITHIN = 0.5  # seconds


class AuditPart:
    """Belongs to the event loop. Bounded: what does not fit is counted, and the audit says so."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = AuditFile(path)
        self._waiting: deque[Event] = deque()
        self._left_out = 0
        self._changed = asyncio.Event()
        self._trouble = ""
        self._storing: asyncio.Task[bool] | None = None

    def audit(self, at: int, event: str) -> None:
        """Keeps an outcome or an acknowledgement, as JSON; `at`: ns since 1970. Never blocks."""
        if len(self._waiting) >= MOST_WAITING:
            self._left_out += 1
            return
        if self._left_out:
            self._add({"event": "left out", "records": self._left_out})
            self._left_out = 0
        self._waiting.append(Event(at, event))
        self._changed.set()

    def _add(self, event: AuditNote) -> None:
        self._waiting.append(Event(time.time_ns(), orjson.dumps(event).decode()))
        self._changed.set()

    def documents(self) -> Mapping[str, Mapping[str, object]]:
        return {"files/audit": {"trouble": self._trouble}}

    # -- the contract of `Keyed` --

    def entries(self) -> Sequence[tuple[str, Callable[[], bytes]]]:
        """Nothing: the audit has only a past."""
        return ()

    def recorded(self, time_range: str, now: int) -> Iterator[tuple[str, str]]:
        asked = timerange.time_range(time_range, now)
        try:
            for number, line in within(read(self._path), asked):
                yield str(number), line.decode(errors="replace")
        except OSError as error:
            raise Busy(f"the audit cannot be read: {error.strerror}") from None

    async def order(self, path: str, data: bytes, by: str | None) -> bytes:
        raise Unknown("the audit takes no orders")

    async def run(self) -> None:
        self._add({"event": "begins"})
        again = AGAIN_FIRST
        try:
            while True:
                await self._changed.wait()
                self._changed.clear()
                if await self._store():
                    again = AGAIN_FIRST
                else:
                    await asyncio.sleep(again)
                    again = min(2 * again, AGAIN_LONGEST)
        finally:
            await self._end()

    async def _end(self) -> None:
        """Writes the last records, if the disk takes them in time."""
        self._add({"event": "ends", "left_out": self._left_out})
        if self._storing is not None:
            await asyncio.wait([self._storing], timeout=CLOSE_WITHIN)
        if self._storing is None or self._storing.done():
            last = asyncio.create_task(self._append([*self._waiting]))
            await asyncio.wait([last], timeout=CLOSE_WITHIN)
        found = self._file.last
        lost = len(self._waiting)
        log.info("audit ends", record=found.number, hash=found.hash, lost=lost)

    async def _store(self) -> bool:
        """Returns True when the oldest waiting records are on disk."""
        batch = [*islice(self._waiting, BATCH)]
        self._storing = asyncio.create_task(self._append(batch))
        return await asyncio.shield(self._storing)

    async def _append(self, batch: Sequence[Event]) -> bool:
        try:
            await off_loop(self._file.append, batch)
        except OSError as error:
            self._failed(words_of(error))
            return False
        self._trouble = ""
        for _ in batch:
            self._waiting.popleft()
        if self._waiting:
            self._changed.set()
        return True

    def _failed(self, why: str) -> None:
        if self._trouble != why:
            log.error("audit not written", why=why)
        self._trouble = why
        self._changed.set()


def _make(core: Core) -> Part | None:
    path = core.config.audit_file
    return None if path is None else AuditPart(path)


KIND = Kind(_make, Phase.KEEPING, serves=Keyed)
