"""Performs polls: with repeated reads and monitor lists, or several of one device at once."""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Poll, Result, Traffic
from gateway.errors import BadValue, Busy, DeviceError, Evidence, Garbled, LineDown, Unsteady
from gateway.line.channel import Channel
from gateway.line.transaction import Transaction
from gateway.planning.planner import Block
from gateway.protocols.capabilities import Monitor
from gateway.protocols.driver import Span, Talk

DIFFER = "two readings in a row differ; verify_reads is for values that change slowly"
OTHER_LIST = "another computer spoke meanwhile: it may have registered a monitor list of its own"
RESULTS = (DeviceError, BadValue, LineDown, Busy)  # errors that are results of a job


async def read_poll(poll: Poll, talk: Transaction) -> Sequence[int]:
    """Returns the units of the span of the poll.

    Raises `Garbled` if the PLC may have got another monitor list meanwhile.
    """
    device, block = poll.device, poll.block
    units = await read_with_care(talk, device, block, span=poll.span, register=poll.register)
    if block.listed and talk.traffic.strange:
        raise Garbled(OTHER_LIST, evidence=Evidence.SHAPE)
    return units


async def read_with_care(
    talk: Talk[Any], device: Device, block: Block, *, span: Span, register: bool = False
) -> Sequence[int]:
    """Returns the units of the span after `verify_reads` equal reads.

    `span`: that of the block, or a longer one around it. `register`: registers the monitor list
    in the PLC first. Raises `Unsteady` if two reads differ in a tag, not only between the tags: a
    check sum does not find every error.
    """
    driver = device.driver
    if register and isinstance(driver, Monitor):
        await driver.register(talk, block.listed)
    units = await _read_once(talk, device, block, span)
    for _ in range(1, device.settings.verify_reads):
        again = await _read_once(talk, device, block, span)
        if list(again) != list(units) and _differ(block, span, again, units):
            raise Unsteady(DIFFER, evidence=Evidence.CHECKSUM)
    return units


def _differ(block: Block, span: Span, one: Sequence[int], other: Sequence[int]) -> bool:
    """Returns True if a tag of the block differs in two reads of the span that are not equal."""
    if block.listed or block.of_fields:  # nothing is between the tags
        return True
    places = ((tag.span.start - span.start, tag.span.size) for tag in block.tags)
    return any(list(one[at : at + n]) != list(other[at : at + n]) for at, n in places)


async def _read_once(talk: Talk[Any], device: Device, block: Block, span: Span) -> Sequence[int]:
    driver = device.driver
    if not block.listed or not isinstance(driver, Monitor):
        return await driver.read(talk, span)
    parts = await driver.read_registered(talk, block.listed)
    return [unit for part in parts for unit in part]


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
        try:
            result: Result = await read_poll(poll, transaction)
        except RESULTS as error:
            result = error
        if wire_log.active:
            wire_log.performed(poll, result, begun, channel.now())
        left -= 1
        traffic = Traffic()
        if not left:
            traffic, transaction.traffic = transaction.traffic, traffic
        conclude(poll, result, traffic)

    await asyncio.gather(*map(one, polls))
