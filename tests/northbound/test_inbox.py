"""The queue from Zenoh's threads to the event loop."""

import asyncio

from gateway.northbound.requests.inbox import LIMIT, Inbox
from tests.northbound.plant import (
    until,
)


async def test_a_full_inbox_refuses_arrivals_and_loses_none_that_it_took() -> None:
    taken: list[int] = []
    refused: list[int] = []
    inbox: Inbox[int] = Inbox(lambda n, _at: taken.append(n), refused.append)

    def fill() -> None:
        for n in range(LIMIT):
            inbox(n)

    await asyncio.to_thread(fill)
    for n in range(LIMIT, LIMIT + 2000):
        inbox(n)
    await until(lambda: len(taken) + len(refused) == LIMIT + 2000)
    assert taken == sorted(taken)
    assert len(refused) >= 2000 - LIMIT
