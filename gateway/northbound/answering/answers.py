"""The threads that send replies, and the room for queries.

A reply blocks while its client does not receive, so no reply is sent on the event loop. Queries
for one key, wildcards and history have threads of their own, and each kind has enough of them that
a few clients on slow links do not keep the others waiting.
"""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue

import structlog
import zenoh

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

Answer = Callable[[zenoh.Query], None]

OPEN_LIMIT = 1024  # queries of one kind, reads or requests, taken and not finished
WIDE_LIMIT = 64  # of these, wildcards
HISTORY_LIMIT = 16  # of these, history
_NARROW_THREADS = 32
_WAIT_OF_BATCH = 0.05  # seconds until another thread goes on with a batch
REFUSALS_LIMIT = 256  # error replies in progress; beyond, one thread sends them in turn
CLOSE_TIMEOUT = 0.5  # seconds for the replies in progress when the gateway ends


@dataclass(slots=True)
class QueryCounters:
    """Counters since the start."""

    queries: int = 0
    refused: int = 0  # because too many queries were open


class AnswerPool:
    """Bounds the open queries of one kind and sends every reply on a thread."""

    def __init__(self, refuse: Answer) -> None:
        """`refuse` replies that the gateway is busy; it is called on an answering thread."""
        self.counters = QueryCounters()
        self._reply_busy = refuse
        self._open = threading.Semaphore(OPEN_LIMIT)
        self._open_wide = threading.Semaphore(WIDE_LIMIT)
        self._open_history = threading.Semaphore(HISTORY_LIMIT)
        self._refusals = threading.Semaphore(REFUSALS_LIMIT)
        self._narrow = Workers(_NARROW_THREADS, "zenoh answers")
        self._wide = Workers(WIDE_LIMIT, "zenoh snapshots")
        self._history = Workers(HISTORY_LIMIT, "zenoh history")
        self._ends = Workers(1, "zenoh ends")
        self._batch: deque[tuple[zenoh.Query, Answer]] = deque()
        self._closing = False
        self._ended = False

    # -- event loop --

    def admit(self, query: zenoh.Query) -> bool:
        """Admits the query; False if there is no room and the query is refused."""
        self.counters.queries += 1
        if self._closing or not self._open.acquire(blocking=False):
            self.refuse(query)
            return False
        return True

    def admit_wide(self, query: zenoh.Query) -> bool:
        """Reserves room for an admitted wide query until `release_wide`; False if the query is
        refused."""
        if self._open_wide.acquire(blocking=False):
            return True
        self._open.release()
        self.refuse(query)
        return False

    def release_wide(self) -> None:
        self._open_wide.release()

    def answer(self, query: zenoh.Query, answer: Answer) -> None:
        """Answers an admitted query. The answers of one loop turn go to a thread together."""
        self._batch.append((query, answer))
        if len(self._batch) == 1:
            asyncio.get_running_loop().call_soon(self._flush)

    def answer_wide(self, query: zenoh.Query, answer: Answer) -> None:
        """Answers an admitted query with a wildcard, if there is room."""
        if self.admit_wide(query):
            self._wide.submit(self._finish, query, answer, self._open_wide)

    def answer_history(self, query: zenoh.Query, answer: Answer) -> None:
        """Answers an admitted query of the past, if there is room."""
        if self._open_history.acquire(blocking=False):
            self._history.submit(self._finish, query, answer, self._open_history)
            return
        self._open.release()
        self.refuse(query)

    def close(self) -> None:
        """Refuses every query from now on."""
        self._closing = True

    async def drain(self) -> None:
        """Waits until all open queries are answered, at most `CLOSE_TIMEOUT`."""
        until = time.monotonic() + CLOSE_TIMEOUT
        for _ in range(OPEN_LIMIT):
            while not self._open.acquire(blocking=False):
                if time.monotonic() > until:
                    return
                await asyncio.sleep(0.01)

    def end(self) -> None:
        """Ends the threads, after the session is closed."""
        self._ended = True
        for pool in (self._narrow, self._wide, self._history, self._ends):
            pool.end()

    def _flush(self) -> None:
        batch, self._batch = self._batch, deque()
        self._go_on(batch)

    def _go_on(self, batch: deque[tuple[zenoh.Query, Answer]]) -> None:
        """Starts a thread with the batch, and later others, if its replies wait for a client."""
        size = len(batch)
        if size and not self._ended:
            self._narrow.submit(self._finish_all, batch)
            if size > 1:
                loop = asyncio.get_running_loop()
                loop.call_later(_WAIT_OF_BATCH, self._go_on, batch)

    # -- any thread --

    def refuse(self, query: zenoh.Query) -> None:
        """Replies busy. Never waits."""
        self.counters.refused += 1
        if self._refusals.acquire(blocking=False):
            self._narrow.submit(self._refuse, query, self._reply_busy, self._refusals)
        else:
            self._ends.submit(self._refuse, query, self._reply_busy)

    def dismiss(self, query: zenoh.Query) -> None:
        """Ends a query without a reply: it is for another gateway."""
        if self._closing or not self._refusals.acquire(blocking=False):
            self._ends.submit(_end, query)
            return
        self._narrow.submit(self._refuse, query, _no_reply, self._refusals)

    # -- answering threads --

    def _refuse(
        self, query: zenoh.Query, reply: Answer, room: threading.Semaphore | None = None
    ) -> None:
        try:
            with query:
                reply(query)
        except zenoh.ZError as error:
            log.debug("refusal failed", error=str(error))
        finally:
            if room is not None:
                room.release()

    def _finish_all(self, batch: deque[tuple[zenoh.Query, Answer]]) -> None:
        while True:
            try:
                query, answer = batch.popleft()
            except IndexError:  # another thread may have taken the last one
                return
            self._finish(query, answer)

    def _finish(
        self, query: zenoh.Query, answer: Answer, room: threading.Semaphore | None = None
    ) -> None:
        try:
            with query:
                answer(query)
        except zenoh.ZError as error:
            log.debug("reply failed", error=str(error))
        finally:
            self._open.release()
            if room is not None:
                room.release()


def _end(query: zenoh.Query) -> None:
    """Waits too while the link of the client is full, for seconds: not on the event loop."""
    with suppress(zenoh.ZError):
        query.drop()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it


def _no_reply(_: zenoh.Query) -> None:
    pass


class Workers:
    """At most `most` threads, which take the submitted work in turn.

    A thread that takes work starts the next one if all are busy. Whoever submits waits for nothing,
    not even for a lock: it may be Zenoh's thread, which receives for all clients.

    They are daemons, unlike those of `concurrent.futures`: the process ends although a reply still
    waits for its client.
    """

    def __init__(self, most: int, name: str) -> None:
        self._most = most
        self._name = name
        self._work: SimpleQueue[Callable[[], object] | None] = SimpleQueue()  # None ends a thread
        self._starting = threading.Lock()
        self._count = 0
        self._busy = set[int]()  # threads, by identifier
        self._start()  # later the system may have none left

    def submit(self, function: Callable[..., object], *arguments: object) -> None:
        """Called by any thread; never waits."""
        self._work.put(partial(function, *arguments))

    def end(self) -> None:
        """Ends each thread when it is idle."""
        self._work.put(None)

    def _start(self) -> None:
        # Without more threads of the system those that run take the work in turn.
        with suppress(RuntimeError):
            threading.Thread(target=self._run, name=self._name, daemon=True).start()
            self._count += 1

    def _run(self) -> None:
        me = threading.get_ident()
        try:
            while (work := self._work.get()) is not None:
                self._busy.add(me)
                self._grow()
                work()
                self._busy.discard(me)
            self._work.put(None)  # for the next thread
        finally:
            with self._starting:
                self._busy.discard(me)
                self._count -= 1

    def _grow(self) -> None:
        if len(self._busy) < self._count or self._count >= self._most:
            return
        with self._starting:
            if len(self._busy) >= self._count < self._most:
                self._start()
