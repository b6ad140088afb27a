"""One write as a conversation: bits of words, acknowledgement, reading back."""

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from gateway.device import Write
from gateway.errors import Refused, Unclear
from gateway.protocols.driver import Talk
from gateway.tags import Written
from gateway.values import Value

Wall = Callable[[], int]


class Differs(Unclear):
    """The write was acknowledged, but reading back does not show it."""


async def carry_out(talk: Talk[Any], write: Write, wall: Wall) -> Written:
    """The whole of one write on one turn. A bit of a word is changed in the word as it is.

    Raises `Differs` where `verify` is asked for and the device does not hold the value.
    """
    driver, tag = write.device.driver, write.tag
    units = write.units
    if tag.address.bit is not None:
        (word,) = await driver.read(talk, tag.span)
        bit = 1 << tag.address.bit
        units = [word | bit if write.units[0] else word & ~bit]
    acknowledged = await driver.write(talk, tag.span, units)
    done = written(write, wall, acknowledged=acknowledged)
    if not acknowledged or tag.write is None or not tag.write.verify:
        return done
    try:
        held = await driver.read(talk, tag.span)
    except Refused as error:
        raise Differs(f"acknowledged, but reading back was refused: {error}") from error
    if not holds(write, held):
        raise Differs(f"acknowledged, but the device now holds {tag.decode(held)!r}")
    return written(write, wall, verified=True)


async def look_again(talk: Talk[Any], write: Write, wall: Wall) -> Written | None:
    """After a write that ended unclear: what its rule allows. None when that settles nothing.

    `verify` reads back what the device holds. `repeat` writes once more.
    """
    rule = write.tag.write
    if rule is None or not (rule.verify or rule.repeat):
        return None
    device = write.device
    device.salt += 1
    await device.driver.resync(talk, device.doubt, device.salt)
    if rule.verify and holds(write, await device.driver.read(talk, write.tag.span)):
        return written(write, wall, verified=True)
    in_time = asyncio.get_running_loop().time() < write.expires
    return await carry_out(talk, write, wall) if rule.repeat and in_time else None


def holds(write: Write, units: Sequence[int]) -> bool:
    """Whether units read from the device are what was written."""
    bit = write.tag.address.bit
    if bit is not None:
        return (units[0] >> bit & 1) == write.units[0]
    return list(units) == list(write.units)


def written(
    write: Write, wall: Wall, *, verified: bool = False, acknowledged: bool = True
) -> Written:
    value: Value | None = write.tag.from_units(write.units)
    took = asyncio.get_running_loop().time() - write.submitted
    return Written(False if value is None else value, wall(), took, verified, acknowledged)
