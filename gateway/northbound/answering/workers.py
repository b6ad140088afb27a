"""Threads for work that may block for long: started when they are needed, never waited for."""

import threading
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue


class Workers:
    """At most `most` threads, which take the submitted work in turn.

    They are daemons, unlike those of `concurrent.futures`: the process ends although a reply still
    waits for its client.
    """

    def __init__(self, most: int, name: str) -> None:
        self._most = most
        self._name = name
        self._work: SimpleQueue[Callable[[], object] | None] = SimpleQueue()  # None ends a thread
        self._idle = threading.Semaphore(0)  # threads that wait for work
        self._lock = threading.Lock()
        self._count = 0

    def submit(self, function: Callable[..., object], *arguments: object) -> None:
        """Called by any thread; never waits."""
        self._work.put(partial(function, *arguments))
        if self._idle.acquire(blocking=False):
            return
        with self._lock:
            if self._count >= self._most:
                return
            self._count += 1
        threading.Thread(target=self._run, name=self._name, daemon=True).start()

    def end(self) -> None:
        """Ends each thread when it is idle."""
        self._work.put(None)

    def _run(self) -> None:
        try:
            while (work := self._work.get()) is not None:
                work()
                self._idle.release()
            self._work.put(None)  # for the next thread
        finally:
            with self._lock:
                self._count -= 1
