"""Opening a port again: the pauses between two tries, and its loan to another program."""

import asyncio
import random
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import NoReturn

from gateway.errors import Lent
from gateway.transport import Port, Receiver

OpenPort = Callable[[Receiver], Awaitable[Port]]
REOPEN_FIRST, REOPEN_LONGEST = 0.2, 10.0  # seconds


class Pauses:
    """The pauses before a port is opened again. Each is twice as long as the one before."""

    def __init__(self, name: str) -> None:
        """`name`: of the line or door: many are not opened at one moment."""
        self._next = REOPEN_FIRST
        self._jitter = random.Random(name)  # noqa: S311  (no secret)

    def restart(self) -> None:
        """Begins with the first one again, because the port worked."""
        self._next = REOPEN_FIRST

    def take(self) -> float:
        """Returns the next pause in seconds."""
        seconds = self._next * self._jitter.uniform(0.8, 1.2)
        self._next = min(2 * self._next, REOPEN_LONGEST)
        return seconds


class Loan:
    """Takes the place of the opener of a line: the line is down, and tries again and again."""

    def __init__(self, opens: OpenPort, why: str, holder: Receiver) -> None:
        """`why`: who has the port, in one sentence."""
        self.opens = opens
        self.holder = holder
        self.left = asyncio.Event()  # the line has closed the port
        self.over = asyncio.Event()
        self._why = why

    async def __call__(self, _receiver: Receiver) -> NoReturn:
        self.left.set()
        raise Lent(self._why)


def own(opens: OpenPort | Loan) -> OpenPort:
    """Returns the opener of the line itself."""
    return opens.opens if isinstance(opens, Loan) else opens


async def pause(opens: OpenPort | Loan, seconds: float) -> None:
    """Waits before the next try to open the port; not longer than another program has it."""
    if not isinstance(opens, Loan):
        await asyncio.sleep(seconds)
        return
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await opens.over.wait()
