"""One poll as a conversation: a span, or a list that is registered first."""

from collections.abc import Sequence
from typing import Any

from gateway.device import Device
from gateway.errors import DeviceError
from gateway.planner import Block
from gateway.protocols.driver import Monitor, Talk


async def read_block(talk: Talk[Any], device: Device, block: Block) -> Sequence[int]:
    """The units of the block. After any trouble a list counts as forgotten by the PLC."""
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
