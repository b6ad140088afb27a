"""Lets the gateway's event loop stand still while the world goes on.

The gateway and the world share one virtual loop. While it stands still, the timers of the gateway
and the bytes for it wait. Then it gets the bytes first and the timers after them, as a real
loop does.
"""

import asyncio
from collections.abc import Callable
from contextvars import Context, ContextVar, copy_context
from dataclasses import dataclass, field
from typing import Any, TypeVar

from gateway.transport import Receiver
from tests.sim.virtual import VirtualLoop

_T = TypeVar("_T")
_GATEWAY: ContextVar[bool] = ContextVar("gateway", default=False)


@dataclass(eq=False)
class _Timer:
    """A timer of the gateway."""

    freezer: "Freezer"
    callback: Callable[..., object]
    args: tuple[Any, ...]
    context: Context
    handle: asyncio.TimerHandle = field(init=False)

    def __call__(self) -> None:
        if self.freezer.frozen:
            self.freezer.timers.append(self)
        else:
            self.callback(*self.args)

    def late(self) -> None:
        if not self.handle.cancelled():
            self.callback(*self.args)


@dataclass(eq=False)
class Freezer:
    """Holds back what would run in the gateway."""

    frozen: int = 0  # causes
    timers: list[_Timer] = field(default_factory=list)
    ears: list["Ear"] = field(default_factory=list)  # with something to report

    def install(self) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        loop.wrap_timer = self._wrap

    def inside(self) -> Context:
        """Returns the context for a task of the gateway."""
        context = copy_context()
        context.run(_GATEWAY.set, True)
        return context

    def _wrap(
        self, callback: Callable[..., object], args: tuple[Any, ...], context: Context | None
    ) -> _Timer | None:
        inside = _GATEWAY.get() if context is None else context.get(_GATEWAY, False)
        return _Timer(self, callback, args, context or copy_context()) if inside else None

    def freeze(self) -> None:
        self.frozen += 1

    def thaw(self) -> None:
        self.frozen -= 1
        if self.frozen:
            return
        ears, self.ears = self.ears, []
        for ear in ears:
            ear.catch_up()
        timers, self.timers = self.timers, []
        loop = asyncio.get_running_loop()
        for timer in timers:
            loop.call_soon(timer.late, context=timer.context)


@dataclass(eq=False)
class Ear:
    """The receiver of a port. Its bytes wait while the loop stands still."""

    freezer: Freezer
    receiver: Receiver
    waiting: bytes = b""
    error: Exception | None = None

    def received(self, data: bytes) -> None:
        if self.freezer.frozen:
            self.waiting += data
            self._wait()
        else:
            self._tell(self.receiver.received, data)

    def lost(self, error: Exception) -> None:
        if self.freezer.frozen:
            self.error = error
            self._wait()
        else:
            self._tell(self.receiver.lost, error)

    def _tell(self, callback: Callable[[_T], object], what: _T) -> None:
        """Calls the gateway: a timer that it sets then is its own."""
        before = _GATEWAY.set(True)
        try:
            callback(what)
        finally:
            _GATEWAY.reset(before)

    def _wait(self) -> None:
        if self not in self.freezer.ears:
            self.freezer.ears.append(self)

    def catch_up(self) -> None:
        waiting, self.waiting = self.waiting, b""
        error, self.error = self.error, None
        if waiting:
            self._tell(self.receiver.received, waiting)
        if error is not None:
            self._tell(self.receiver.lost, error)
