"""The end of a program: on a signal, and at last although a thread, or a library, does not end."""

import asyncio
import faulthandler
import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any

WITHIN = 9.0  # seconds: what runs containers kills them ten seconds after the signal


class LastResort:
    """Ends the process `WITHIN` seconds after `start` with code 1, unless it is cancelled."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._timer = threading.Timer(WITHIN, _end, [loop])
        self._timer.daemon = True

    def start(self) -> bool:
        """Returns False if it was started before."""
        if self._timer.is_alive():
            return False
        with suppress(RuntimeError):  # the system has no thread left
            self._timer.start()
            # Without Python, should a library hold its lock.
            faulthandler.dump_traceback_later(WITHIN + 1, exit=True)
        return True

    def cancel(self) -> None:
        self._timer.cancel()
        faulthandler.cancel_dump_traceback_later()


def stop_event(*more: signal.Signals) -> asyncio.Event:
    """Returns an event that SIGTERM, SIGINT and `more` set. From then on the `LastResort` runs."""
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    last = LastResort(loop)

    def end() -> None:
        stop.set()
        last.start()

    for number in (signal.SIGTERM, signal.SIGINT, *more):
        loop.add_signal_handler(number, end)
    return stop


def _end(loop: asyncio.AbstractEventLoop) -> None:
    """Says what has not ended, and where each thread stands."""
    tasks: set[asyncio.Task[Any]] = asyncio.all_tasks(loop)
    left = sorted({getattr(task.get_coro(), "__qualname__", "?") for task in tasks})
    left += [thread.name for thread in threading.enumerate()]
    text = f"not ended {WITHIN:g} s after the signal: the process ends with {', '.join(left)}"
    print(text, file=sys.stderr, flush=True)
    faulthandler.dump_traceback()
    os._exit(1)
