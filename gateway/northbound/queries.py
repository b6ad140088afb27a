"""Questions from the network, each answered or refused, and always finished.

The event loop only sorts them. Replies block while the asker does not listen, so they are made on
threads: `narrow` ones of one key, and `wide` ones of a wildcard, which must not hold up the others.
"""

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import structlog
import zenoh

from gateway.engine.requests import CommandResult
from gateway.errors import BadValue, Busy
from gateway.northbound.controls import Controls
from gateway.northbound.directory import Directory
from gateway.northbound.keys import Asked, Family, asked, max_age
from gateway.northbound.payload import Failure, Problem
from gateway.northbound.plant import Plant
from gateway.northbound.replies import Replies
from gateway.northbound.writes import ANSWER_WITHIN, Writes, asker
from gateway.tags import Tag, WriteResult

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

Documents = Callable[[], dict[str, bytes]]  # the status, by full key
Answer = Callable[[zenoh.Query], None]

OPEN_LIMIT = 1024  # queries taken and not finished
WIDE_LIMIT = 64  # of these, wildcards and history
REFUSALS_LIMIT = 256  # refusals on their way; beyond, a query ends without a word
FRESH_LIMIT = 256  # tags that one query may have read from the devices
_BUSY = Failure(Problem.BUSY, "too many questions are waiting; nothing was done")


@dataclass(slots=True)
class Asks:
    """Counters since the start."""

    queries: int = 0
    refused: int = 0  # for want of room
    unanswered: int = 0  # not even a refusal had room


class Queries:
    """Takes queries on the event loop and sees each to its end."""

    def __init__(
        self,
        plant: Plant,
        directory: Directory,
        writes: Writes,
        replies: Replies,
        documents: Documents,
        controls: Controls | None = None,
    ) -> None:
        self.counters = Asks()
        self._plant = plant
        self._directory = directory
        self._writes = writes
        self._replies = replies
        self._documents = documents
        self._controls = controls
        self._open = threading.Semaphore(OPEN_LIMIT)
        self._open_wide = threading.Semaphore(WIDE_LIMIT)
        self._refusals = threading.Semaphore(REFUSALS_LIMIT)
        self._narrow = ThreadPoolExecutor(3, "zenoh answers")
        self._wide = ThreadPoolExecutor(2, "zenoh snapshots")
        self._batch: list[tuple[zenoh.Query, Answer]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._closing = False

    # -- event loop --

    def take(self, query: zenoh.Query) -> None:
        """Starts the answer to one query."""
        self.counters.queries += 1
        if self._closing or not self._open.acquire(blocking=False):
            self.refuse(query)
            return
        wanted = asked(str(query.key_expr))
        match wanted.family:
            case Family.SET:
                self._task(self._set(query))
            case Family.COMMAND if self._controls is not None:
                self._task(self._command(query, self._controls))
            case Family.STATUS if query.parameters.get("_time") is not None:
                self._widely(query, partial(self._replies.writes, time.time_ns()))
            case Family.STATUS:
                self._task(self._status(query))
            case Family.VALUE if query.parameters.get("_time") is not None:
                self._widely(query, partial(self._replies.history, wanted, time.time_ns()))
            case Family.VALUE if query.parameters.get("max_age") is not None:
                if wanted.is_wild:
                    self._in_wide_room(query, self._fresh(query, wanted))
                else:
                    self._task(self._fresh(query, wanted))
            case _ if wanted.is_wild or wanted.family is Family.BLOCK:
                self._widely(query, partial(self._replies.current, wanted))
            case _:
                self._soon(query, partial(self._replies.current, wanted))

    async def close(self) -> None:
        """Ends what waits for devices, and gives every answer half a second to leave."""
        self._closing = True
        self._replies.end()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        until = time.monotonic() + 0.5
        for _ in range(OPEN_LIMIT):
            while not self._open.acquire(blocking=False):
                if time.monotonic() > until:
                    return
                await asyncio.sleep(0.01)

    def end(self) -> None:
        """After the session is closed."""
        self._narrow.shutdown(wait=False, cancel_futures=True)
        self._wide.shutdown(wait=False, cancel_futures=True)

    async def _set(self, query: zenoh.Query) -> None:
        key, data = str(query.key_expr), query.payload
        result: WriteResult | Failure = Failure(Problem.UNCLEAR, "the gateway is ending")
        try:
            result = await self._writes.write(
                key, None if data is None else data.to_bytes(), asker(query)
            )
        finally:
            self._soon(query, partial(self._replies.outcome, result))

    async def _command(self, query: zenoh.Query, controls: Controls) -> None:
        key, data = str(query.key_expr), query.payload
        result: CommandResult | Failure = Failure(Problem.UNCLEAR, "the gateway is ending")
        try:
            result = await controls.obey(
                key, None if data is None else data.to_bytes(), asker(query)
            )
        finally:
            self._soon(query, partial(controls.reply, result))

    async def _status(self, query: zenoh.Query) -> None:
        documents: dict[str, bytes] = {}
        try:
            documents = self._documents()
        finally:
            self._soon(query, partial(self._replies.status, documents))

    async def _fresh(self, query: zenoh.Query, wanted: Asked) -> None:
        ending = Failure(Problem.UNCLEAR, "the gateway is ending")
        answer: Answer = partial(self._replies.outcome, ending)
        try:
            tags = self._directory.find(wanted.of)
            unread = await self._read(tags, query.parameters.get("max_age") or "")
            answer = partial(self._replies.fresh, tags, unread)
        except BadValue as error:
            answer = partial(self._replies.outcome, Failure(Problem.BAD_QUERY, str(error)))
        finally:
            self._soon(query, answer)

    async def _read(self, tags: Sequence[Tag], age_text: str) -> list[Tag]:
        """Reads those that are too old, and what gets too old meanwhile; each once at most.

        Returns those that could not be read in time.
        """
        unread = list[Tag]()
        if not tags:
            return unread  # another gateway's
        age = max_age(age_text)
        if len(tags) > FRESH_LIMIT:
            raise BadValue(f"{len(tags)} tags are meant; max_age reads at most {FRESH_LIMIT}")
        until = asyncio.get_running_loop().time() + ANSWER_WITHIN
        left = dict.fromkeys(tags)
        while old := [tag for tag in left if not self._plant.is_fresh(tag, age)]:
            for tag in old:
                del left[tag]
            read = await asyncio.gather(*(self._read_one(tag, age, until) for tag in old))
            unread += [tag for tag, was_read in zip(old, read, strict=True) if not was_read]
        return unread

    async def _read_one(self, tag: Tag, age: float, until: float) -> bool:
        try:
            async with asyncio.timeout_at(until):
                await self._plant.fresh(tag, age)
        except (Busy, TimeoutError):
            return False
        return True

    def _task(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _in_wide_room(self, query: zenoh.Query, work: Coroutine[None, None, None]) -> None:
        if self._has_wide_room(query):
            self._task(work).add_done_callback(lambda _: self._open_wide.release())
        else:
            work.close()

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            log.error("a query failed", exc_info=error)

    def _soon(self, query: zenoh.Query, answer: Answer) -> None:
        """Answers of one turn of the loop go to a thread together."""
        self._batch.append((query, answer))
        if len(self._batch) == 1:
            asyncio.get_running_loop().call_soon(self._flush)

    def _flush(self) -> None:
        batch, self._batch = self._batch, []
        self._narrow.submit(self._finish_all, batch).add_done_callback(_report)

    def _widely(self, query: zenoh.Query, answer: Answer) -> None:
        if not self._has_wide_room(query):
            return
        future = self._wide.submit(self._finish, query, answer)
        future.add_done_callback(lambda _: self._open_wide.release())
        future.add_done_callback(_report)

    def _has_wide_room(self, query: zenoh.Query) -> bool:
        """Otherwise the query is refused."""
        if self._open_wide.acquire(blocking=False):
            return True
        self._open.release()
        self.refuse(query)
        return False

    # -- any thread --

    def refuse(self, query: zenoh.Query) -> None:
        """Busy; if even that has to wait too long, the query just ends: nothing was done."""
        self.counters.refused += 1
        if self._closing or not self._refusals.acquire(blocking=False):
            self.counters.unanswered += 1
            query.drop()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
            return
        self._narrow.submit(self._refuse, query).add_done_callback(_report)

    # -- answering threads --

    def _refuse(self, query: zenoh.Query) -> None:
        try:
            with query:
                self._replies.outcome(_BUSY, query)
        finally:
            self._refusals.release()

    def _finish_all(self, batch: Iterable[tuple[zenoh.Query, Answer]]) -> None:
        for query, answer in batch:
            self._finish(query, answer)

    def _finish(self, query: zenoh.Query, answer: Answer) -> None:
        try:
            with query:
                answer(query)
        except zenoh.ZError as error:
            log.debug("the asker is gone", error=str(error))
        finally:
            self._open.release()


def _report(future: Future[None]) -> None:
    if not future.cancelled() and (error := future.exception()):
        log.error("an answer failed", exc_info=error)
