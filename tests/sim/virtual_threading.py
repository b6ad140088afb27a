"""Puts the virtual clock, threads and Zenoh session into the gateway for one run."""

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import isclass, isfunction
from typing import Any

import zenoh

import gateway.plant.threads as threads_module
from tests.sim.threads import Condition, Event, Lock, Semaphore, SimpleQueue, Thread, Turns

KINDS = (Thread, Lock, Condition, Event, Semaphore, SimpleQueue)


class Threading:
    """Replaces the module `threading` in the gateway."""

    def __init__(self, turns: Turns) -> None:
        self._turns = turns
        for kind in KINDS:
            own = type(kind.__name__, (kind,), {"turns": turns})
            setattr(self, kind.__name__, own)

    def get_ident(self) -> int:
        running = self._turns.running
        return 0 if running is None else running.ident or 0

    def __getattr__(self, name: str) -> Any:
        return getattr(threading, name)


class Time:
    """Replaces the module `time` in the gateway."""

    def __init__(self, monotonic: Callable[[], float], time_ns: Callable[[], int]) -> None:
        self.monotonic = monotonic
        self.time_ns = time_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(time, name)


@contextmanager
def replaced(
    opened: Callable[[zenoh.Config], Any], turns: Turns, wall: Callable[[], int]
) -> Iterator[None]:
    """Replaces `threading`, `time` and `zenoh.open` in the gateway, also as default arguments.

    `opened`: returns the session. `wall`: ns since 1970.
    """
    threads, virtual = Threading(turns), Time(turns.loop.time, wall)
    instead = {"threading": threads, "time": virtual, "SimpleQueue": vars(threads)["SimpleQueue"]}
    clocks = {time.monotonic: virtual.monotonic, time.time_ns: virtual.time_ns}
    undo: list[tuple[Any, str, Any]] = [(zenoh, "open", zenoh.open)]
    zenoh.open = opened  # type: ignore[assignment]
    for module in [m for name, m in sys.modules.items() if name.startswith("gateway.")]:
        for name, new in instead.items():
            old = vars(module).get(name)
            if old is not None:
                undo.append((module, name, old))
                setattr(module, name, new)
        for kind in filter(isclass, list(vars(module).values())):
            for function in filter(isfunction, vars(kind).values()):
                defaults = function.__defaults__ or ()
                if any(default in clocks for default in defaults if callable(default)):
                    undo.append((function, "__defaults__", defaults))
                    function.__defaults__ = tuple(
                        clocks.get(default, default) if callable(default) else default
                        for default in defaults
                    )
    threads_module._spare.cache_clear()  # its queue is of this run
    try:
        yield
    finally:
        threads_module._spare.cache_clear()
        for owner, name, old in reversed(undo):
            setattr(owner, name, old)
