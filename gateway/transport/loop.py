"""Creates the event loop: uvloop's with an exact clock, or asyncio's own where it has no wheel."""

import asyncio
import importlib
import time
from typing import Any


def new_event_loop() -> asyncio.AbstractEventLoop:
    """Returns a new loop, for `asyncio.Runner(loop_factory=...)`."""
    uvloop = _uvloop()
    return asyncio.new_event_loop() if uvloop is None else _exact(uvloop)


def _uvloop() -> Any:
    """Returns the uvloop library, or None where it is not installed."""
    try:
        return importlib.import_module("uvloop")
    except ImportError:
        return None


def _exact(uvloop: Any) -> asyncio.AbstractEventLoop:
    """Returns a uvloop loop that reads the system's monotonic clock.

    uvloop's own clock counts milliseconds and stands still while code runs, too coarse for a
    silence of 1.75 ms. Its timers use the same monotonic clock.
    """
    loop: asyncio.AbstractEventLoop = type(
        "ExactLoop", (uvloop.Loop,), {"time": staticmethod(time.monotonic)}
    )()
    return loop
