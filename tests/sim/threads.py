"""Threads on virtual time: the loop or one thread runs, and each switch is at a known place.

The gateway's threads are real ones, but each waits for its turn. A turn ends where the thread
waits: for a condition, an event, a queue, another thread, or room on a link. Then the virtual loop
goes on. So a run with threads is repeated exactly, and a wait of the event loop is an error.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count
from queue import Empty
from types import TracebackType
from typing import Any

from tests.sim.virtual import VirtualLoop

_AT_ONCE = 0.002  # seconds of work that are spent together: fewer switches


class Ended(BaseException):
    """Unwinds a thread at the end of a run."""


class _Wait:
    """One thread that waits."""

    def __init__(self, thread: "Thread") -> None:
        self.thread = thread
        self.over = False
        self.woken = False


Queue = deque[_Wait]


def _closed_lock() -> threading.Lock:
    lock = threading.Lock()
    lock.acquire()
    return lock


class Turns:
    """Gives the turn to one thread at a time."""

    def __init__(self, loop: VirtualLoop) -> None:
        self.loop = loop
        self.running: Thread | None = None
        self.crashed: list[str] = []
        self.ending = False
        self._threads: list[Thread] = []
        self._numbers = count(1)
        self._back = _closed_lock()
        self._debt = 0.0

    # -- any thread --

    def wait(self, queue: Queue, timeout: float | None = None) -> bool:
        """Waits until `wake`. Returns False after `timeout` seconds."""
        thread = self.running
        if self.ending:
            raise Ended
        if thread is None:
            raise RuntimeError("the event loop waits for a thread")
        wait = _Wait(thread)
        queue.append(wait)
        timer = None if timeout is None else self.loop.call_later(timeout, self._end, wait)
        self._back.release()
        thread.turn.acquire()
        if self.ending:
            raise Ended
        if timer is not None:
            timer.cancel()
        if not wait.woken:
            queue.remove(wait)
        return wait.woken

    def wake(self, queue: Queue, most: int = 1) -> None:
        """Wakes the longest waiting threads."""
        while queue and most > 0:
            wait = queue.popleft()
            wait.woken = True
            most -= 1
            if not wait.over:
                wait.over = True
                self.loop.call_soon(self._pass, wait.thread)

    def spend(self, seconds: float) -> None:
        """Lets the running thread work for so long."""
        if self.running is not None:
            self._debt += seconds
            if self._debt >= _AT_ONCE:
                work, self._debt = self._debt, 0.0
                self.wait(deque(), work)

    def add(self, thread: "Thread") -> int:
        self._threads.append(thread)
        self.loop.call_soon(self._pass, thread)
        return next(self._numbers)

    # -- the loop --

    def end(self) -> None:
        """Unwinds all threads: the run has ended."""
        self.ending = True
        for thread in self._threads:
            if thread.is_alive():
                thread.turn.release()
                thread.real.join()

    def _end(self, wait: _Wait) -> None:
        if not wait.over:
            wait.over = True
            self._pass(wait.thread)

    def _pass(self, thread: "Thread") -> None:
        if self.ending:
            return
        self.running = thread
        thread.turn.release()
        self._back.acquire()
        self.running = None

    # -- a thread that ends --

    def ended(self, thread: "Thread", error: Exception | None) -> None:
        if error is not None:
            self.crashed.append(f"thread {thread.name} failed: {error!r}")
        if not self.ending:
            self.wake(thread.joining, len(thread.joining))
            self._back.release()


class Thread:
    """As `threading.Thread`."""

    turns: Turns

    def __init__(
        self,
        target: Callable[..., object],
        args: Sequence[object] = (),
        name: str = "",
        daemon: bool = True,
    ) -> None:
        self.name = name
        self.ident: int | None = None
        self.turn = _closed_lock()
        self.joining: Queue = deque()
        self.real = threading.Thread(target=self._run, args=(target, args), daemon=True)

    def start(self) -> None:
        self.real.start()
        self.ident = self.turns.add(self)

    def is_alive(self) -> bool:
        return self.real.is_alive() and self.ident != 0

    def join(self, timeout: float | None = None) -> None:
        if self.is_alive():
            self.turns.wait(self.joining, timeout)

    def _run(self, target: Callable[..., object], args: Sequence[object]) -> None:
        self.turn.acquire()
        error = None
        try:
            if not self.turns.ending:
                target(*args)
        except Ended:
            pass
        except Exception as crashed:  # noqa: BLE001 - the run reports it
            error = crashed
        self.ident = 0
        self.turns.ended(self, error)


class Lock:
    """As `threading.Lock`: no thread waits while it has one, unless the gateway is wrong."""

    turns: Turns

    def __init__(self) -> None:
        self._held = False
        self._queue: Queue = deque()

    def __enter__(self) -> None:
        while self._held:
            self.turns.wait(self._queue)
        self._held = True

    def __exit__(
        self, _: type[BaseException] | None, error: BaseException | None, __: TracebackType | None
    ) -> None:
        self._held = False
        self.turns.wake(self._queue)


class Condition(Lock):
    """As `threading.Condition`."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: Queue = deque()

    def wait(self, timeout: float | None = None) -> bool:
        self.__exit__(None, None, None)
        try:
            return self.turns.wait(self._waiting, timeout)
        finally:
            if not self.turns.ending:
                self.__enter__()

    def notify(self) -> None:
        self.turns.wake(self._waiting)


class Event:
    """As `threading.Event`."""

    turns: Turns

    def __init__(self) -> None:
        self._set = False
        self._waiting: Queue = deque()

    def is_set(self) -> bool:
        return self._set

    def clear(self) -> None:
        self._set = False

    def set(self) -> None:
        self._set = True
        self.turns.wake(self._waiting, len(self._waiting))

    def wait(self, timeout: float | None = None) -> bool:
        if not self._set and (self.turns.running is not None or timeout is None):
            self.turns.wait(self._waiting, timeout)
        return self._set  # the loop, which may wait a moment, never waits on virtual time


class Semaphore:
    """As `threading.Semaphore`."""

    turns: Turns

    def __init__(self, value: int = 1) -> None:
        self._value = value
        self._waiting: Queue = deque()

    def acquire(self, blocking: bool = True) -> bool:
        while not self._value:
            if not blocking:
                return False
            self.turns.wait(self._waiting)
        self._value -= 1
        return True

    def release(self) -> None:
        self._value += 1
        self.turns.wake(self._waiting)


class SimpleQueue:
    """As `queue.SimpleQueue`."""

    turns: Turns

    def __init__(self) -> None:
        self._items: deque[Any] = deque()
        self._waiting: Queue = deque()

    def put(self, item: object) -> None:
        self._items.append(item)
        self.turns.wake(self._waiting)

    def get(self) -> Any:
        while not self._items:
            self.turns.wait(self._waiting)
        return self._items.popleft()

    def get_nowait(self) -> Any:
        if not self._items:
            raise Empty
        return self._items.popleft()
