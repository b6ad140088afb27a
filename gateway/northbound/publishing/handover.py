"""Loop and publishing thread take turns: both need the same lock of Python.

With many values to send the loop gives the thread slices of time, and waits meanwhile. Otherwise
the thread gets the lock only while the loop waits for a system call, and each of its puts may wait
for the loop: it sends less the more there is to send. A thread that hangs in a put gets no slices:
the loop does not wait for a link that is stuck. The longer the loop had, the longer is a slice. So
where both together have too much to do, the loop reads less, and what it has read goes out at once.
"""

import asyncio
import threading
import time
from collections.abc import Callable
from math import inf

# Seconds of a slice: so many times as long as the loop had since the one before, within these ends.
SHARE, SHORTEST, LONGEST = 2.0, 0.002, 0.008
_MANY = 50  # waiting puts for which the loop waits
_PATIENCE = 0.02  # seconds that the loop waits for a slice; one that takes longer hangs in a put:
_CALM = 0.1  # the loop does not wait for so many seconds
_ALONE = 0.05  # seconds without a slice after which the thread goes on by itself


class Handover:
    """The lock of the queue, and the slices of the thread."""

    def __init__(self, waiting: Callable[[], int]) -> None:
        """`waiting`: returns the number of waiting puts."""
        self.lock = threading.Condition()
        self.closing = False  # the thread ends when nothing waits
        self.puts = 0  # since the start
        self.until = inf  # the slice ends then, by the monotonic clock
        self._waiting = waiting
        self._over = threading.Event()
        self._calm = -inf  # the loop does not wait before, by the monotonic clock,
        self._stuck_at = -1  # nor while there were so many puts
        self._comes = False  # the next slice is scheduled
        self._ended = 0.0  # the last one

    # -- event loop --

    def soon(self) -> None:
        """Wakes the thread at the end of this pass of the loop, for what was queued in it."""
        if not self._comes:
            self._comes = True
            asyncio.get_running_loop().call_soon(self._slice)

    def _slice(self) -> None:
        self._comes = False
        waits = self._waiting() >= _MANY and self.puts != self._stuck_at
        waits = waits and time.monotonic() >= self._calm
        with self.lock:
            self._over.clear()
            self.let_run()
            if not waits:
                return
            now = time.monotonic()
            self.until = now + min(max(SHORTEST, SHARE * (now - self._ended)), LONGEST)
        in_time = self._over.wait(_PATIENCE)
        self._ended = time.monotonic()
        if not in_time:
            self._calm, self._stuck_at = time.monotonic() + _CALM, self.puts
            self.until = inf
        elif self._waiting():
            self.soon()

    # -- any thread --

    def let_run(self) -> None:
        """Lets the thread go on without slices. The caller has the lock."""
        self.until = inf
        self.lock.notify()

    # -- the thread --

    def rest(self) -> None:
        """Waits for something to send. The caller has the lock."""
        self._over.set()
        self.lock.wait()

    def give_back(self) -> None:
        """Ends a slice, and waits for the next one."""
        with self.lock:
            self._over.set()
            self.lock.wait(_ALONE)
