"""Closes the Zenoh sessions while the event loop stands still.

Zenoh's own threads go on without the loop: links and liveliness tokens would stay, and clients and
the standby would take the last values for current. With the sessions the tokens end.
"""

import asyncio
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress

import structlog
import zenoh

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

LIMIT = 5.0  # seconds without a turn of the loop
_TICK = 0.25  # seconds


class Watchdog:
    """A thread that counts its own ticks since the last turn of the loop.

    It does not compare times: after a pause of the whole process both go on, and no limit has
    passed.
    """

    def __init__(
        self, sessions: Callable[[], Iterable[zenoh.Session]], on_return: Callable[[], None]
    ) -> None:
        """`on_return` is called on the loop, when it turns again after the sessions are closed."""
        self.has_fired = False
        self._sessions = sessions
        self._on_return = on_return
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        self._turned = True
        self._ended = threading.Event()

    @contextmanager
    def watching(self) -> Iterator[None]:
        thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)
        thread.start()
        self._turn()
        try:
            yield
        finally:
            self._ended.set()
            self._next_turn.cancel()

    def _turn(self) -> None:
        self._turned = True
        self._next_turn = self._loop.call_later(_TICK, self._turn)

    # -- the watchdog's thread --

    def _watch(self) -> None:
        missed = 0
        while not self._ended.wait(_TICK):
            missed = 0 if self._turned else missed + 1
            self._turned = False
            # The loop turns once per tick: it may miss one without being late.
            if missed * _TICK > LIMIT:
                self._fire()
                return

    def _fire(self) -> None:
        began = time.monotonic() - LIMIT
        self.has_fired = True
        log.error("event loop stands still", at=self._place(), effect="the Zenoh session is closed")
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._returned, began)
        for session in self._sessions():
            with suppress(zenoh.ZError):
                session.close()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it

    def _place(self) -> str:
        """Returns the line that the loop's thread is in."""
        frame = sys._current_frames().get(self._loop_thread)
        if frame is None:
            return "unknown"
        return f"{frame.f_code.co_filename}:{frame.f_lineno}"

    # -- the loop again --

    def _returned(self, began: float) -> None:
        stood = round(time.monotonic() - began, 1)
        log.error("event loop stood still", seconds=stood, effect="the gateway starts over")
        self._on_return()
