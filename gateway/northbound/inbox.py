"""The only way from Zenoh's threads to the event loop: a bounded queue and one wake-up.

Zenoh calls on the thread that receives everything for the session, so the call does nothing but
append. What finds no room is handed back at once.
"""

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

T = TypeVar("T")

LIMIT = 1024  # arrivals that wait for the loop
_AT_ONCE = 16  # taken in one turn of the loop, so that everything else has its turn


class Inbox(Generic[T]):
    """Hands every arrival to `sink` on the event loop; beyond `LIMIT` to `refuse` at once."""

    def __init__(self, sink: Callable[[T], None], refuse: Callable[[T], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._sink = sink
        self._refuse = refuse
        self._queue: deque[T] = deque()
        self._woken = False

    def __call__(self, arrival: T) -> None:
        """From Zenoh's thread."""
        if len(self._queue) >= LIMIT:
            self._refuse(arrival)
            return
        self._queue.append(arrival)
        if not self._woken:
            self._woken = True
            with suppress(RuntimeError):  # the loop is closed: so will be the session
                self._loop.call_soon_threadsafe(self._drain)

    def _drain(self) -> None:
        self._woken = False  # before anything is taken: what comes from now on wakes again
        for _ in range(_AT_ONCE):
            if not self._queue:
                return
            self._sink(self._queue.popleft())
        if self._queue and not self._woken:
            self._woken = True
            self._loop.call_soon(self._drain)
