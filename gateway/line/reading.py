"""One poll as a conversation: a span, or a list that is registered first; twice where asked."""

from collections.abc import Awaitable, Sequence
from typing import Any

from gateway.engine.device import Device
from gateway.errors import DeviceError, Evidence, Unsteady
from gateway.planning.planner import Block
from gateway.protocols.driver import Monitor, Talk

_DIFFER = "two readings in a row differ; verify_reads is for values that change slowly"


def read_block(talk: Talk[Any], device: Device, block: Block) -> Awaitable[Sequence[int]]:
    """The units of the block, read as often as `verify_reads` says.

    Raises `Unsteady` where two readings do: a check sum does not see everything.
    """
    if block.listed or device.verify_reads > 1:
        return _read_with_care(talk, device, block)
    return device.driver.read(talk, block.span)


async def _read_with_care(talk: Talk[Any], device: Device, block: Block) -> Sequence[int]:
    units = await _read_once(talk, device, block)
    for _ in range(1, device.verify_reads):
        if list(await _read_once(talk, device, block)) != list(units):
            raise Unsteady(_DIFFER, evidence=Evidence.CHECKSUM)
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
