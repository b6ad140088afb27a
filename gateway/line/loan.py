"""The port of a line while another program has it."""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import NoReturn

from gateway.errors import Lent
from gateway.transport import Port, Receiver

OpenPort = Callable[[Receiver], Awaitable[Port]]


class Loan:
    """Takes the place of the opener of a line: the line is down, and tries again and again."""

    def __init__(self, opens: OpenPort, why: str) -> None:
        """`why`: who has the port, in one sentence."""
        self.opens = opens
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
