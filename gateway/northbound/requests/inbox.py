"""The only way from Zenoh's threads to the event loop: a bounded queue and one wake-up.

Zenoh calls on the thread that receives everything for the session, so the call only notes the
time and appends. An arrival that finds the queue full is refused at once.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

T = TypeVar("T")

LIMIT = 1024  # arrivals that wait for the loop
_BATCH_SIZE = 16  # taken in one turn of the loop, so that other tasks get their turn


class Inbox(Generic[T]):
    """Hands every arrival to `sink` on the event loop; beyond `LIMIT` to `refuse` at once.

    `sink` also gets the time of the arrival, by the clock of the loop.
    """

    def __init__(
        self, sink: Callable[[T, float], None], refuse: Callable[[T], None], more: int = 0
    ) -> None:
        """`more`: arrivals beyond `LIMIT` that may wait too."""
        self._loop = asyncio.get_running_loop()
        self._sink = sink
        self._refuse = refuse
        self._more = more
        self._queue: deque[tuple[T, float]] = deque()
        self._drain_scheduled = False

    def __call__(self, arrival: T) -> None:
        """Called on Zenoh's thread."""
        if len(self._queue) >= LIMIT + self._more:
            self._refuse(arrival)
            return
        self._queue.append((arrival, self._loop.time()))
        if not self._drain_scheduled:
            self._drain_scheduled = True
            with suppress(RuntimeError):  # the loop is closed, and the session will be
                self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        self._drain_scheduled = False  # first: an arrival from now on schedules the next drain
        for _ in range(_BATCH_SIZE):
            if not self._queue:
                return
            self._sink(*self._queue.popleft())
        if self._queue and not self._drain_scheduled:
            self._drain_scheduled = True
            self._loop.call_soon(self._drain)
