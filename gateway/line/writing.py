"""Orders as conversations: writes alone and together, bits of words, reading back, commands."""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

from gateway.engine.device import Device
from gateway.engine.requests import Command, Write
from gateway.engine.results import Consequences
from gateway.errors import BadValue, Busy, GatewayError, LineDown, Refused, Unclear
from gateway.line.transaction import Turn
from gateway.protocols.driver import AnyDriver, Controllable, ScatteredWriter, Span, Talk
from gateway.tags import WriteResult
from gateway.values import Value

Wall = Callable[[], int]
STOPPED = "the gateway stopped before the acknowledgement came; it may have been done"


class Differs(Unclear):
    """The write was acknowledged, but reading back does not show it."""


async def carry_out(talk: Talk[Any], write: Write, wall: Wall) -> WriteResult:
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


async def look_again(talk: Talk[Any], write: Write, wall: Wall) -> WriteResult | None:
    """After a write that ended unclear: what its rule allows. None when that settles nothing.

    `verify` reads back what the device holds. `repeat` writes once more.
    """
    rule = write.tag.write
    if rule is None or not (rule.verify or rule.repeat):
        return None
    device = write.device
    try:
        await device.driver.resync(talk, device.doubt, device.next_salt())
    except Refused as error:
        raise Unclear(f"nor what it says to a question about it: {error}") from error
    if rule.verify and holds(write, await device.driver.read(talk, write.tag.span)):
        return written(write, wall, verified=True)
    in_time = asyncio.get_running_loop().time() < write.expires
    return await carry_out(talk, write, wall) if rule.repeat and in_time else None


def together(writes: Sequence[Write]) -> bool:
    """Whether all these writes to one device can go out in one exchange."""
    driver = writes[0].device.driver
    if not isinstance(driver, ScatteredWriter) or not all(write.plain for write in writes):
        return False
    return driver.scattered_write_cost([write.tag.span for write in writes]) is not None


def not_obeyed(driver: AnyDriver, command: str, *, control: bool) -> str:
    """Why a device does not take this command; empty where it does."""
    known = driver.controls if isinstance(driver, Controllable) else frozenset()
    if not known:
        return f"a {driver.protocol} device takes no commands"
    if command not in known:
        return f"{command!r} is none of its commands: {', '.join(sorted(known))}"
    return "" if control else "the file does not say `control: true` of it"


def holds(write: Write, units: Sequence[int]) -> bool:
    """Whether units read from the device are what was written."""
    if write.tag.shape is not None:  # what is written is bytes, what is read is a value
        return write.tag.decode(units) == write.tag.from_units(write.units)
    bit = write.tag.address.bit
    if bit is not None:
        return (units[0] >> bit & 1) == write.units[0]
    return list(units) == list(write.units)


def written(
    write: Write, wall: Wall, *, verified: bool = False, acknowledged: bool = True
) -> WriteResult:
    value: Value | None = write.tag.from_units(write.units)
    took = asyncio.get_running_loop().time() - write.submitted
    return WriteResult(False if value is None else value, wall(), took, verified, acknowledged)


class Wire(Protocol):
    """What carrying out orders needs of the line."""

    def turn_with(self, device: Device) -> AbstractContextManager[Turn]: ...

    async def unclear(
        self, device: Device, turn: Turn, error: Unclear, asked: Span | None
    ) -> None: ...

    def hold(self, device: Device) -> None:
        """Keep quiet for a while: a broadcast has gone out."""


@dataclass(slots=True)
class Writer:
    """Carries out orders, and tells each asker what became of it, exactly once."""

    wire: Wire
    then: Consequences
    wall: Wall

    async def write(self, write: Write, others: Sequence[Write] = ()) -> None:
        """One write; `others` go out in the same exchange, and each alone if that is refused."""
        group = [write, *others]
        outcomes: dict[Write, WriteResult | GatewayError] = {}
        try:
            if others:
                group = await self._all_at_once(group, outcomes)
            else:
                outcomes[write] = Unclear(STOPPED)
                outcomes[write] = await self._one(write)
        except LineDown as error:
            for one in outcomes:
                outcomes[one] = Unclear(f"{error}; nobody knows whether the write was done")
                one.device.doubt = one.tag.span
            raise
        finally:
            for one in group:
                self._tell(one, outcomes.get(one, LineDown("the line went down; not sent")))

    async def command(self, command: Command) -> None:
        device = command.device
        outcome: str | GatewayError = Unclear(STOPPED)
        try:
            outcome = await self._obeyed(command)
        except LineDown as error:
            outcome = Unclear(f"{error}; nobody knows whether {command.name} was done")
            device.doubtful = True
            raise
        finally:
            command.done(outcome)

    async def _obeyed(self, command: Command) -> str | GatewayError:
        device, driver = command.device, command.device.driver
        if why := not_obeyed(driver, command.name, control=device.control):
            return BadValue(why)
        if not isinstance(driver, Controllable):
            raise TypeError(f"{device.name} takes no commands")
        with self.wire.turn_with(device) as turn:
            try:
                answer = await driver.control(turn, command.name, command.argument)
            except BadValue as error:
                return error
            except Refused as error:
                return self._denied(device, error)
            except Unclear as error:
                await self.wire.unclear(device, turn, error, None)
                return error if turn.sent else Busy(str(error))
            if turn.exchanges:
                self.then.answered(device)
            else:  # as after a broadcast
                self.wire.hold(device)
            return answer

    async def _all_at_once(
        self, group: list[Write], outcomes: dict[Write, WriteResult | GatewayError]
    ) -> list[Write]:
        """Those whose outcome is known: none when the device refused the whole."""
        device = group[0].device
        driver = device.driver
        if not isinstance(driver, ScatteredWriter):
            raise TypeError(f"{device.name} takes one write at a time")
        parts = [(one.tag.span, one.units) for one in group]
        with self.wire.turn_with(device) as turn:
            outcomes.update((one, Unclear(STOPPED)) for one in group)
            try:
                await driver.write_scattered(turn, parts)
            except Refused as error:
                self._denied(device, error)
                self.then.schedule.orders.each_alone(group)
                return []
            except Unclear as error:
                outcomes.update((one, error if turn.sent else Busy(str(error))) for one in group)
                await self.wire.unclear(device, turn, error, group[0].tag.span)
                return group
            self.then.answered(device)
            outcomes.update((one, written(one, self.wall)) for one in group)
            return group

    async def _one(self, write: Write) -> WriteResult | GatewayError:
        """Never simply sent again: what may follow an unclear end is the tag's own rule."""
        device, span = write.device, write.tag.span
        with self.wire.turn_with(device) as turn:
            try:
                return self._noted(device, await carry_out(turn, write, self.wall))
            except Refused as error:
                return self._denied(device, error)
            except Differs as error:
                self.then.answered(device)
                return error
            except Unclear as error:
                unclear = error
                await self.wire.unclear(device, turn, error, span)
                if not turn.sent:
                    return Busy(str(error))
        with self.wire.turn_with(device) as turn:
            try:
                settled = await look_again(turn, write, self.wall)
                return unclear if settled is None else self._noted(device, settled)
            except Refused as error:  # not what became of the first try
                self._denied(device, error)
            except Differs as error:
                self.then.answered(device)
                return error
            except Unclear as error:
                await self.wire.unclear(device, turn, error, span)
        return unclear

    def _tell(self, write: Write, outcome: WriteResult | GatewayError) -> None:
        record = write.device.record
        record.writes += 1
        took = asyncio.get_running_loop().time() - write.submitted
        record.slowest_write = max(record.slowest_write, took)
        write.done(outcome)
        self.then.hasten(write.device, write.tag)

    def _denied(self, device: Device, error: Refused) -> Refused:
        self.then.answered(device)
        device.record.refusals[error.code] += 1
        return error

    def _noted(self, device: Device, done: WriteResult) -> WriteResult:
        if done.acknowledged:
            self.then.answered(device)
        else:  # a broadcast: stations need time to take it in
            self.wire.hold(device)
        return done
