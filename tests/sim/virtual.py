"""An event loop whose clock jumps to the next timer, so that no test waits."""

import asyncio
import functools
import selectors
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, NoReturn, ParamSpec, TypeVar

from structlog.testing import capture_logs

P = ParamSpec("P")
T = TypeVar("T")
LOOKS_APART = 256  # passes between two looks at real file descriptors (signals, if anything)
BUSY_PASSES = 8  # passes of the loop without progress of the clock: some task polls it
TICK = 5e-4


class Deadlock(RuntimeError):
    """All tasks wait, and no timer is set."""


class _Selector(selectors.SelectSelector):
    """Moves the clock on instead of waiting."""

    loop: "VirtualLoop"
    _passes = 0

    def select(self, timeout: float | None = None) -> Any:
        self._passes += 1
        ready: list[Any] = []
        if timeout is None or self._passes % LOOKS_APART == 0:
            ready = super().select(0)
            if ready:
                return ready
        if timeout is None:
            raise Deadlock("virtual deadlock: nothing is scheduled and nothing will be")
        self.loop.pass_time(timeout)
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """Time stands still while code runs, and jumps to the next timer when all tasks wait.

    The clock also moves on for a task that polls it.
    Threads are forbidden: a jump of the clock would overtake them.
    """

    def __init__(self, start: float = 1000.0) -> None:
        selector = _Selector()
        super().__init__(selector)
        selector.loop = self
        self._now = start
        self._clock_resolution = 1e-9
        self._passes = 0
        self.wrap_timer: Callable[..., Any] | None = None  # may return another callback

    def call_at(  # type: ignore[override]  # its generic signature says no more
        self, when: float, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        wrapped = self.wrap_timer and self.wrap_timer(callback, args, context)
        if wrapped is None:
            return super().call_at(when, callback, *args, context=context)
        wrapped.handle = super().call_at(when, wrapped, context=context)
        return wrapped.handle  # type: ignore[no-any-return]

    def time(self) -> float:
        return self._now

    def pass_time(self, seconds: float) -> None:
        if seconds > 0:
            self._passes = 0
            self._now += seconds
            return
        self._passes += 1
        if self._passes > BUSY_PASSES:
            self._now += TICK

    # No arguments are needed to refuse.
    def run_in_executor(self, *_: Any) -> NoReturn:  # type: ignore[override]
        raise RuntimeError("no threads under virtual time")


def run_virtual(coroutine: Coroutine[Any, Any, T]) -> T:
    """Runs a coroutine on a virtual clock of its own. Raises `Deadlock`."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(coroutine)


def on_virtual_time(test: Callable[P, Awaitable[None]]) -> Callable[P, None]:
    """Makes a test of a coroutine, on a virtual clock. The log is not shown."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        async def whole() -> None:
            await test(*args, **kwargs)

        with capture_logs():
            run_virtual(whole())

    return run


def now() -> float:
    """Returns the time of the running loop."""
    return asyncio.get_running_loop().time()
