"""The model of a modem on a pseudo terminal, on the event loop of a test."""

import asyncio
import os
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Self

from tests.transport.modem import NEVER, ModemModel

PATIENCE = 300.0  # seconds; never waited for when all is well


class PtyModem:
    """`path` is the port of the gateway."""

    def __init__(self, model: ModemModel) -> None:
        self.model = model
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._timer: asyncio.TimerHandle | None = None
        self._news = asyncio.Event()

    async def __aenter__(self) -> Self:
        asyncio.get_running_loop().add_reader(self._master, self._read)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._master)
        if self._timer is not None:
            self._timer.cancel()
        os.close(self._master)
        os.close(self._slave)

    def say(self, data: bytes) -> None:
        """The modem, or the caller in a call, sends this to the gateway."""
        if data:
            os.write(self._master, data)
        if self._timer is not None:
            self._timer.cancel()
        if self.model.due < NEVER:
            self._timer = asyncio.get_running_loop().call_at(self.model.due, self._tick)
        self._news.set()

    async def until_online(self, online: bool = True) -> None:
        await self.until(lambda model: model.online is online)

    async def until_ready(self) -> None:
        """Waits for the last command of the setup."""
        await self.until(lambda model: "ATS0=0" in model.commands)

    async def until(self, happened: Callable[[ModemModel], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not happened(self.model):
                self._news.clear()
                await self._news.wait()

    def _read(self) -> None:
        self.say(self.model.feed(os.read(self._master, 4096), _now()))

    def _tick(self) -> None:
        self.say(self.model.tick(_now()))


def _now() -> float:
    return asyncio.get_running_loop().time()
