"""The event loop that ports live on: uvloop's; on Windows, where there is none, asyncio's own."""

import asyncio
import importlib
import time
from typing import Any


def new_event_loop() -> asyncio.AbstractEventLoop:
    """For `asyncio.Runner(loop_factory=...)`."""
    uvloop = _uvloop()
    return asyncio.new_event_loop() if uvloop is None else _exact(uvloop)


def _uvloop() -> Any:
    """The library, or None where there is none."""
    try:
        return importlib.import_module("uvloop")
    except ImportError:
        return None


def _exact(uvloop: Any) -> asyncio.AbstractEventLoop:
    """uvloop's own clock counts milliseconds and stands still while code runs: a silence of 1.75 ms
    cannot be kept by it. So it is told the time by the system's clock, the one its timers use too.
    """
    loop: asyncio.AbstractEventLoop = type(
        "ExactLoop", (uvloop.Loop,), {"time": staticmethod(time.monotonic)}
    )()
    return loop
