"""Performs several polls at once, of a device that takes several requests at once."""

import asyncio
from collections.abc import Callable, Sequence

from gateway.engine.jobs.jobs import Poll, Result, Traffic
from gateway.line.channel import Channel
from gateway.line.perform import perform
from gateway.line.transaction import Transaction


async def perform_together(
    polls: Sequence[Poll],
    transaction: Transaction,
    channel: Channel,
    conclude: Callable[[Poll, Result, Traffic], None],
) -> None:
    """Performs the polls in one transaction. Its traffic counts with the last."""
    left, wire_log = len(polls), channel.wire_log

    async def one(poll: Poll) -> None:
        nonlocal left
        begun = channel.now()
        result = await perform(poll, transaction)
        if wire_log.active:
            wire_log.performed(poll, result, begun, channel.now())
        left -= 1
        traffic = Traffic()
        if not left:
            traffic, transaction.traffic = transaction.traffic, traffic
        conclude(poll, result, traffic)

    await asyncio.gather(*map(one, polls))
