"""One poll as a conversation: a span, or a list that is registered first; twice where asked."""

from collections.abc import Sequence
from typing import Any

from gateway.device import Device
from gateway.errors import DeviceError, Evidence, Garbled
from gateway.planner import Block
from gateway.protocols.driver import Monitor, Talk


async def read_block(talk: Talk[Any], device: Device, block: Block) -> Sequence[int]:
    """The units of the block, read as often as `verify_reads` says.

    Raises `Garbled` where two readings differ: a check sum does not see everything.
    """
    units = await _read_once(talk, device, block)
    for _ in range(1, device.verify_reads):
        if list(await _read_once(talk, device, block)) != list(units):
            raise Garbled("two readings in a row differ", evidence=Evidence.CHECKSUM)
    return units


async def _read_once(talk: Talk[Any], device: Device, block: Block) -> Sequence[int]:
    """After any trouble a list counts as forgotten by the PLC."""
    driver = device.driver
    if not block.listed or not isinstance(driver, Monitor):
        return await driver.read(talk, block.span)
    try:
        if device.registered != block.listed:
            await driver.register(talk, block.listed)
            device.registered = block.listed
        parts = await driver.read_registered(talk, block.listed)
    except DeviceError:
        device.registered = ()
        raise
    return [unit for part in parts for unit in part]
