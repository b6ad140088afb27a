"""Runs blocking calls beside the event loop: files, names, planning."""

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from queue import SimpleQueue
from types import TracebackType
from typing import Self, TypeVar

from gateway.errors import GatewayError

T = TypeVar("T")


class _Outcome:
    """Passes the result of a thread, or its error, to a future of the loop."""

    def __init__(self, future: asyncio.Future[object]) -> None:
        self._future = future
        self._loop = future.get_loop()
        self.result: object = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._settle, error)
        return True

    def _settle(self, error: BaseException | None) -> None:
        if self._future.done():
            return
        if error is None:
            self._future.set_result(self.result)
        else:
            self._future.set_exception(error)


async def off_loop(
    function: Callable[..., T], *arguments: object, within: float | None = None
) -> T:
    """Runs a blocking call on its own daemon thread, which delays neither the loop nor the exit.

    If the system has no thread left, the calls wait for one that was started with the first.

    Raises what the call raises, and `GatewayError` after `within` seconds: the thread goes on.
    """
    future: asyncio.Future[T] = asyncio.get_running_loop().create_future()

    def run() -> None:
        with _Outcome(future) as outcome:  # type: ignore[arg-type]  # a future of any type
            outcome.result = function(*arguments)

    called = getattr(function, "__name__", type(function).__name__)
    spare = _spare()
    try:
        threading.Thread(target=run, name=f"gateway {called}", daemon=True).start()
    except RuntimeError:
        spare.put(run)
    try:
        async with asyncio.timeout(within):
            return await future
    except TimeoutError:
        if not future.cancelled():
            raise
        raise GatewayError(f"{called} did not end within {within:g} s") from None


@cache
def _spare() -> SimpleQueue[Callable[[], None]]:
    """Returns the queue of the thread that takes what no new thread can."""
    calls: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def take() -> None:
        while True:
            calls.get()()

    threading.Thread(target=take, name="gateway spare", daemon=True).start()
    return calls
