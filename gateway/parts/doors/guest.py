"""One program at a door: its requests, and the replies that it still waits for."""

import asyncio
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gateway.errors import LineDown
from gateway.line.line import Line
from gateway.parts.doors.documents import GuestDocument
from gateway.parts.doors.guest_requests import NOT_NOW, Outcome, Unanswered
from gateway.parts.doors.stores import Needs, Outcomes, Step
from gateway.stations.served.answering import Heard
from gateway.transport import Port

if TYPE_CHECKING:
    from gateway.parts.doors.open_door import OpenDoor

MOST_WAITING = 4096  # bytes of requests; a program that sends more is disconnected


class Guest:
    """One connection. It answers the requests in their order, one at a time.

    Frames without a number say nothing of the request that they answer. So a reply is dropped when
    more bytes have arrived meanwhile, or when it comes too late: the program would take it for the
    reply to its next request.
    """

    def __init__(self, door: "OpenDoor", line: Line, address: str) -> None:
        self._door = door
        self._address = address
        self._since = asyncio.get_running_loop().time()
        self._requests = self._writes = self._refused = self._unanswered = 0
        self._steps: list[Step] = []
        devices = door.devices
        self._outcomes = {one.name: Outcomes() for one in devices.values()}
        needs = {number: Needs(one.name, self._steps) for number, one in devices.items()}
        self._asks = door.machine(line, needs)
        told = {number: self._outcomes[one.name] for number, one in devices.items()}
        self._tells = door.machine(line, told)
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._arrived = asyncio.Event()
        self._port: Port | None = None
        self._work: asyncio.Task[None] | None = None

    # The receiver of the connection

    def opened(self, port: Port) -> None:
        self._port = port
        self._work = self._door.start(self._serve())
        self._door.guests.add(self)

    def received(self, data: bytes) -> None:
        now = asyncio.get_running_loop().time()
        waiting = sum(len(piece) for _, piece in self._waiting) + len(data)
        # What arrives while this process is held is as old as the hold: its reply would be late.
        if waiting > MOST_WAITING or self._door.why_not(now):
            self.leave()
            return
        self._waiting.append((now, data))
        self._arrived.set()

    def lost(self, _error: Exception) -> None:
        self._port = None
        self.leave()

    def leave(self, _why: str = "") -> None:
        """Closes the connection. A request that was sent goes on, and is in the audit."""
        self._door.guests.discard(self)
        if self._work is not None:
            self._work.cancel()
        if self._port is not None:
            self._door.start(self._port.close())
            self._port = None

    # The requests

    async def _serve(self) -> None:
        while True:
            await self._arrived.wait()
            at, data = self._waiting.popleft()
            if not self._waiting:
                self._arrived.clear()
            more = True
            while more:
                self._asks.hear(data, at)
                steps = [*self._steps]
                self._steps.clear()
                answered = await self._carry_out(steps, at)
                told = self._tells.hear(data, at)
                for outcome in self._outcomes.values():
                    outcome.forget()
                self._count(told)
                if told.reply:
                    await self._reply(told, at, answered=answered)
                if told.lost:
                    self.leave()
                more, data = told.more, b""

    async def _carry_out(self, steps: Sequence[Step], at: float) -> bool:
        """Returns False if a device did not reply, or was not asked."""
        answered, door, loop = True, self._door, asyncio.get_running_loop()
        for step in steps:
            for run in step.runs() if not step.writes else ():
                door.reads.note(step.device, run, loop.time())
            left = at + door.settings.reply_within - loop.time()
            outcome: Outcome
            by = f"door {door.settings.name}, {self._address}"
            if step.writes and not self._may_write():
                why = "its certificate has no role that may write"
                outcome = door.turns.deny(step, by, why)
            elif left > 0:
                work = door.turns.carry_out(step, door.settings, by, left)
                outcome = await asyncio.shield(door.start(work))
            else:
                outcome = NOT_NOW
            self._outcomes[step.device].note(step, outcome)
            answered = answered and not isinstance(outcome, Unanswered)
        return answered

    def _may_write(self) -> bool:
        return self._port is not None and self._door.may_write(self._port)

    def _count(self, told: Heard) -> None:
        self._requests += len(told.done)
        self._writes += sum(done.write and not done.refused for done in told.done)
        self._refused += sum(bool(done.refused) for done in told.done)
        self._unanswered += told.stale

    async def _reply(self, told: Heard, at: float, *, answered: bool) -> None:
        if not self._door.numbered:
            await asyncio.sleep(told.delay)
            late = asyncio.get_running_loop().time() - at > self._door.settings.reply_within
            if not answered or late or self._waiting:
                self._unanswered += 1
                return
        if self._port is not None:
            try:
                self._port.write(told.reply)
            except LineDown:
                self.leave()

    def document(self, now: float) -> GuestDocument:
        counts = (self._requests, self._writes, self._refused, self._unanswered)
        return guest_document(self._address, now - self._since, *counts)


def guest_document(
    address: str,
    since: float,
    requests: int = 0,
    writes: int = 0,
    refused: int = 0,
    unanswered: int = 0,
) -> GuestDocument:
    """Returns the document of one program; `since`: seconds ago."""
    return {
        "address": address,
        "since": round(since, 1),
        "requests": requests,
        "writes": writes,
        "refused": refused,
        "unanswered": unanswered,
    }
