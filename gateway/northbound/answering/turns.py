"""Lets one long answer work at a time, slice by slice, and current values before history.

An answer with thousands of replies keeps the interpreter busy. Without turns a few of them together
would delay the event loop and every short answer. An answer that waits for its client, because the
link is slow, loses its turn: other clients do not wait for that link.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import IntEnum

SLICE = 0.003  # seconds of work before the next answer may go on
_BLOCKED = 0.02  # seconds after which a turn is taken from an answer that waits for its client
_SHARE_OF_HISTORY = 8  # of so many turns in a row, history gets one

Pause = Callable[[], None]


class Rank(IntEnum):
    """The order of waiting answers."""

    CURRENT = 0
    HISTORY = 1


class _Turn:
    """The place of one answer in the order."""

    def __init__(self) -> None:
        self.since = 0.0  # when it began
        self.begins = threading.Event()


class AnswerTurns:
    """Used by the answering threads."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._holder: _Turn | None = None
        self._waiting: dict[Rank, deque[_Turn]] = {rank: deque() for rank in Rank}
        self._in_a_row = 0  # turns of current values while history waits

    @contextmanager
    def turn(self, rank: Rank) -> Iterator[Pause]:
        """Waits for a turn. The answer calls the yielded function often: it gives way to other
        answers when the slice has ended."""
        turn = self._take(rank)

        def pause() -> None:
            nonlocal turn
            lost = self._holder is not turn
            if lost or (self._clock() - turn.since >= SLICE and any(self._waiting.values())):
                turn = self._take(rank, turn)

        try:
            yield pause
        finally:
            self._give_back(turn)

    def _take(self, rank: Rank, last: _Turn | None = None) -> _Turn:
        """Waits for a turn; `last`: the turn that this answer had before and gives back."""
        turn = _Turn()
        with self._lock:
            self._waiting[rank].append(turn)
            if self._holder in (None, last):
                self._pass_on()
        while not turn.begins.wait(_BLOCKED):
            with self._lock:
                holder = self._holder
                if holder is not None and self._clock() - holder.since >= _BLOCKED:
                    self._pass_on()
        return turn

    def _give_back(self, turn: _Turn) -> None:
        with self._lock:
            if self._holder is turn:
                self._pass_on()

    def _pass_on(self) -> None:
        """Gives the turn to the next answer. Call it with the lock."""
        current, history = self._waiting[Rank.CURRENT], self._waiting[Rank.HISTORY]
        self._in_a_row = self._in_a_row + 1 if current and history else 0
        queue = current
        if not current or self._in_a_row >= _SHARE_OF_HISTORY:
            queue, self._in_a_row = history, 0
        self._holder = queue.popleft() if queue else None
        if self._holder is not None:
            self._holder.since = self._clock()
            self._holder.begins.set()
