"""The requests of all doors of one line: one after another, in their share of the wire."""

import asyncio
import math
from collections.abc import Mapping
from contextlib import suppress

from gateway.contract.interfaces import North
from gateway.errors import BadValue, Busy, GatewayError, Offline, Refused, Unclear
from gateway.parts.doors.settings import Door
from gateway.parts.doors.stores import Step
from gateway.plant.any_address import AnyAddress
from gateway.stations.store import Cell, Denied, Rejected, Why

Outcome = Mapping[Cell, int] | Denied | Rejected
GIVES_WAY = 3.0  # while polls are late, programs get this part of their share
_MINUTE = 60.0  # seconds over which the share is measured


class Unanswered(Rejected):
    """No reply of the device stands behind this one. `code`: as a Modbus gateway says it."""


NOT_NOW, NO_REPLY = Unanswered("06"), Unanswered("0B")


class GuestRequests:
    """One line. Belongs to the event loop.

    The engine of the line plans each request as it plans those of other clients: with its
    silences, its rules about late replies and its resyncs.
    """

    def __init__(self, any_address: AnyAddress, north: North, most: float = 1.0) -> None:
        """`most`: the share of all doors together."""
        self._any = any_address
        self._north = north
        self._turn = asyncio.Lock()
        self._turns = dict[str, asyncio.Lock]()  # of each door
        # By the loop's clock: when the share of each door allows its next request; of all: "".
        self._free_at = dict[str, float]()
        self._late_at = dict[str, float]()  # the same while polls are late
        self._most = most
        self._unclear: tuple[Door, float] | None = None  # the last one, and the resyncs until then
        self._share, self._shared_at = 0.0, 0.0

    async def carry_out(self, step: Step, door: Door, by: str, within: float) -> Outcome:
        """Returns what the device did. After `within` seconds no request is sent any more."""
        if door.max_age and not step.writes and (known := self._known(step, door.max_age)):
            return known
        loop = asyncio.get_running_loop()
        ends = loop.time() + within
        turn = self._turns.setdefault(door.name, asyncio.Lock())
        if not await _acquired(turn, ends):
            return NOT_NOW
        try:
            if not await self._begin(step.device, door, ends):
                return NOT_NOW
            left = ends - loop.time()
            before = self._any.requested(step.device)
            try:
                return await (self._write if step.writes else self._read)(step, door, by, left)
            finally:
                self._spend(self._any.requested(step.device) - before, door)
                self._turn.release()
        except Refused as error:
            return Rejected(error.code)
        except BadValue:
            return Denied(Why.NO_TAG)
        except Busy:
            return NOT_NOW
        except Unclear:
            self._unclear = door, self._any.resyncs(step.device)
            return NO_REPLY
        except GatewayError:
            return NO_REPLY
        finally:
            turn.release()

    async def _begin(self, device: str, door: Door, ends: float) -> bool:
        """Waits until the shares allow a request, and takes the turn of the line. Returns False if
        that is too late. A door that waits for its own share holds up no other."""
        now = asyncio.get_running_loop().time
        while True:
            self._spend_resync(device)
            free_at = max(self._free_at.get(name, 0.0) for name in (door.name, ""))
            if free_at > ends:
                return False
            await asyncio.sleep(free_at - now())
            if self._any.is_late(device):
                late_at = max(self._late_at.get(name, 0.0) for name in (door.name, ""))
                await asyncio.sleep(min(late_at - now(), (ends - now()) / 2))  # it is in time
            if not await _acquired(self._turn, ends):
                return False
            if self._free_at.get("", 0.0) <= now():
                return True
            self._turn.release()  # another door has used the share of all

    def _known(self, step: Step, max_age: float) -> Mapping[Cell, int]:
        """Returns what polls have read in the last `max_age` seconds; empty: not all of it."""
        found = dict[Cell, int]()
        for run in step.runs():
            try:
                units = self._any.known(step.device, run, max_age)
            except Offline:
                return {}
            if units is None:
                return {}
            found |= {(run.area, run.start + ahead): unit for ahead, unit in enumerate(units)}
        return found

    async def _read(self, step: Step, _door: Door, _by: str, within: float) -> Outcome:
        found = dict[Cell, int]()
        for run in step.runs():
            units = await self._any.read(step.device, run, within)
            found |= {(run.area, run.start + ahead): unit for ahead, unit in enumerate(units)}
        return found

    def deny(self, step: Step, by: str, why: str) -> Denied:
        """Audits a write that the door does not carry out."""
        for run in step.runs():
            with suppress(GatewayError):  # the device has no such address, or is gone
                tag = self._any.target(step.device, run)
                self._north.deny_own(tag, tag.from_units(step.units(run)), by, why)
        return Denied(Why.NOT_ACCEPTED)

    async def _write(self, step: Step, door: Door, by: str, within: float) -> Outcome:
        if not all(door.may_write(step.device, *cell) for cell in step.cells):
            return self.deny(step, by, f"`writes` of door {door.name} does not name it")
        runs, done = [*step.runs()], 0
        tags = [self._any.target(step.device, run) for run in runs]  # before the first is sent
        values = [tag.from_units(step.units(run)) for run, tag in zip(runs, tags, strict=True)]
        try:
            for tag, value in zip(tags, values, strict=True):
                if value is None or None in values:
                    return Denied(Why.BAD)
                took = await self._north.write_own(tag, value, by, within, repeated=False)
                if took.value != value:  # the device took another one
                    return NO_REPLY if done else Denied(Why.BAD)
                done += 1
        except GatewayError:
            if done:  # a refusal would say that nothing was
                return NO_REPLY
            raise
        finally:
            self._any.refresh(step.device, runs)
        return {}

    def _spend(self, seconds: float, door: Door) -> None:
        """Notes the time that the line has spent on a request, with its resyncs and time-outs: the
        next one waits until the share of its door allows it, and that of all."""
        if seconds <= 0.0:
            return
        now = asyncio.get_running_loop().time()
        self._share = self.share(now) + seconds / _MINUTE
        self._shared_at = now
        for name, most in ((door.name, door.most), ("", self._most)):
            begun = max(self._free_at.get(name, 0.0), now - seconds)
            self._free_at[name] = begun + seconds / most
            self._late_at[name] = begun + GIVES_WAY * seconds / most

    def _spend_resync(self, device: str) -> None:
        """Notes the time of the resync after a request without a reply, once it has ended."""
        if self._unclear is not None:
            door, before = self._unclear
            if (seconds := self._any.resyncs(device) - before) > 0.0:
                self._unclear = None
                self._spend(seconds, door)

    def share(self, now: float) -> float:
        """Returns the share of the wire time in the last minute."""
        return self._share * math.exp((self._shared_at - now) / _MINUTE)


async def _acquired(lock: asyncio.Lock, ends: float) -> bool:
    """Returns False if the lock was not free until `ends`."""
    try:
        async with asyncio.timeout_at(ends):
            await lock.acquire()
    except TimeoutError:
        return False
    return True
