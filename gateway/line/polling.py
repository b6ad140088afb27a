"""Polls and probes as conversations: one block, several at once, a sign of life."""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from gateway.engine.device import Device
from gateway.engine.jobs import Poll
from gateway.engine.results import Consequences
from gateway.errors import LineDown, Refused, Unclear, Unsteady
from gateway.line.reading import read_block
from gateway.line.transaction import Turn
from gateway.protocols.driver import Span

Failure = tuple[Poll, Unclear | LineDown]


class Wire(Protocol):
    """What polling needs of the line."""

    def begin(self, device: Device) -> Turn: ...

    def end(self, device: Device, turn: Turn) -> None: ...

    async def unclear(
        self, device: Device, turn: Turn, error: Unclear, asked: Span | None
    ) -> None: ...


@dataclass(slots=True)
class Poller:
    """Carries out polls and probes."""

    wire: Wire
    then: Consequences

    async def poll(self, poll: Poll, now: float) -> None:
        """One block; with it what else is due of a device that takes several questions at once."""
        device, others = poll.device, list[Poll]()
        turn = self.wire.begin(device)
        try:
            if device.window > 1:
                others = self.then.schedule.beside(poll, device.window - 1, now)
            if not others:
                failed = await self._read(turn, poll)
            else:
                reads = (self._read(turn, one) for one in (poll, *others))
                failed = [failure for end in await asyncio.gather(*reads) for failure in end]
            if failed:
                await self._failed(device, turn, failed)
        finally:
            self.wire.end(device, turn)
            if not poll.hurried:
                device.used(turn.clock.now(), now)

    async def probe(self, device: Device, now: float) -> None:
        """Ask something harmless whose answer is no other's."""
        turn = self.wire.begin(device)
        try:
            salt, told_from = device.next_salt(), 0
            with suppress(Refused):  # a sign of life too, though perhaps of an older question
                told_from = await device.driver.resync(turn, device.doubt, salt)
            if device.open_questions(self.then.flowed) > told_from:
                await turn.settle(device.patience, device.patience)
                with suppress(Refused):
                    await device.driver.resync(turn, device.doubt, salt + 1)
            self.then.answered(device)
        except Unclear as error:
            await self.wire.unclear(device, turn, error, None)
        finally:
            self.wire.end(device, turn)
            device.used(turn.clock.now(), now)

    async def _read(self, turn: Turn, poll: Poll) -> Sequence[Failure]:
        """Empty when it was answered."""
        device = poll.device
        try:
            units = await read_block(turn, device, poll.block)
        except Refused as error:
            self.then.answered(device)
            self.then.refused(poll, error)
        except Unsteady as error:
            self.then.answered(device)
            self.then.unsteady(poll, error)
        except (Unclear, LineDown) as error:
            return [(poll, error)]
        else:
            self.then.answered(device)
            self.then.read(poll, units, turn.clock.now())
        return ()

    async def _failed(self, device: Device, turn: Turn, failed: Sequence[Failure]) -> None:
        first, error = failed[0]
        if isinstance(error, LineDown):
            device.doubt = first.block.span
            raise error
        await self.wire.unclear(device, turn, error, first.block.span)
        for one, why in failed:
            self.then.unread(one, why)
