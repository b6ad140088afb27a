"""What follows from how a conversation went: for the device, the schedule, and those who watch."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import structlog

from gateway.engine.device import Device, Standing
from gateway.engine.jobs import Poll
from gateway.engine.schedule import Schedule
from gateway.engine.staleness import Overdue
from gateway.errors import (
    Evidence,
    Garbled,
    GatewayError,
    LineDown,
    Refusal,
    Refused,
    Unclear,
    Unsteady,
)
from gateway.planning.planner import describe
from gateway.protocols.driver import Span
from gateway.tags import Reason, Sample, Tag, bad
from gateway.tags.unchanged import Unchanged

log = structlog.get_logger("gateway.line")
BUSY_PAUSE = 0.2  # seconds left to a device that said it was busy, doubled each time


class Upstairs(Protocol):
    """What a line hands its news to. Called on the event loop."""

    def samples(self, samples: Sequence[Sample]) -> None: ...

    def alive(self, device: Device, alive: bool) -> None: ...


@dataclass(slots=True)
class Consequences:
    """Draws them. Never waits, never speaks on the wire."""

    line: str
    schedule: Schedule
    upstairs: Upstairs
    wall: Callable[[], int]  # ns since 1970
    overdue: Overdue = field(init=False)

    def __post_init__(self) -> None:
        self.overdue = Overdue(self.schedule, self.bad)

    def read(self, poll: Poll, units: Sequence[int], now: float) -> None:
        """A block was read well."""
        device, block = poll.device, poll.block
        poll.read(now)
        self.upstairs.samples(self._samples(poll, units))
        if block.of_fields:
            self._note_garbled(device, units)
        self.schedule.polled(poll, now)
        refusals = device.refusals
        if refusals.searching or refusals.bad:
            if refusals.read(block):
                log.info("address is there now", device=device.name, block=describe(poll.block))
                self._replan(device)
            self._settle(device)
        if not refusals.searching and device.learn():
            log.info("planned anew", device=device.name, turnaround=device.reckoned)
            self.schedule.plan(device, now)

    def _samples(self, poll: Poll, units: Sequence[int]) -> Sequence[Sample]:
        """What was read. The same units mean the same values: they are not decoded again."""
        time, told = self.wall(), poll.told
        if told is None or units != poll.units or poll.block.eager:
            poll.units = units
            poll.told = told = poll.block.decode(units, time)
        elif not isinstance(told, Unchanged):
            poll.told = told = Unchanged(told, time)
        elif told.superseded:
            poll.told = told = poll.block.decode(units, time)
        else:
            told.time = time
        return told

    def _note_garbled(self, device: Device, fields: Sequence[Any]) -> None:
        """A good frame may hold a field that cannot be read."""
        for value in fields:
            if isinstance(value, Garbled):
                device.record.failures[value.evidence] += 1
                heard = value.data.hex(" ")
                log.info("not understood", device=device.name, why=str(value), bytes=heard)

    @property
    def flowed(self) -> float:
        """When anything was read last on this line: what was asked before has gone through."""
        polls = (poll for device in self.schedule.devices for poll in self.schedule.polls(device))
        return max((at for poll in polls if (at := poll.last_good) is not None), default=-math.inf)

    def answered(self, device: Device) -> None:
        """The device said something to the point, good or bad news."""
        if device.standing is Standing.UP and not device.doubtful:
            return
        before = device.standing
        device.answered()
        if before in (Standing.STARTING, Standing.SILENT):
            self.upstairs.alive(device, True)
            log.info("device answers", line=self.line, device=device.name)
            device.refusals.abandon()
            self.schedule.woke(device, _now())
            self.overdue.watch()

    def doubt(self, device: Device, error: Unclear, asked: Span | None) -> Standing:
        """A conversation ended unclear. Returns the device's standing before."""
        before = device.standing
        device.failed(error, asked, _now())
        log.info("no good reply", line=self.line, device=device.name, why=str(error))
        self.overdue.watch()
        return before

    def unclear(self, device: Device, before: Standing, took: float, late: float | None) -> None:
        """The quiet after an unclear conversation is over; it took `took` seconds in all.

        `late`: how long after the time-out the right answer came, if it came.
        """
        if late is not None:
            device.record.late += 1
            if device.open_questions(self.flowed) <= 1:  # otherwise perhaps of an older one
                device.doubtful = False
                device.unanswered.clear()
            total = device.timing.reply_timeout + late
            device.trouble = Garbled(
                f"it took {total:.2f} s, reply_timeout is {device.timing.reply_timeout:g} s",
                evidence=Evidence.SLOW,
            )
        if before is not Standing.SILENT:
            self.schedule.failed(_now(), took)
        unknown = before in (Standing.STARTING, Standing.SILENT)
        if not unknown and device.failures <= device.timing.retries:
            return
        if device.broadcast:  # no question could bring it back: only its own word can
            device.start()
            if not unknown:
                self.upstairs.alive(device, False)
            return
        self.schedule.silent(device, _now(), took)
        self.bad(device.asked, device.reason, device.diagnosis())
        if before is not Standing.SILENT:
            self.upstairs.alive(device, False)
            log.warning("device silent", device=device.name, why=device.diagnosis())

    def unread(self, poll: Poll, error: GatewayError) -> None:
        """A poll ended unclear: again in its turn, or its tags are bad."""
        device = poll.device
        if device.standing is Standing.SILENT:
            return
        if poll.tries < device.timing.retries and not poll.setbacks:
            self.schedule.again(poll)
            return
        poll.forget(_now())
        self.bad(poll.block.tags, device.reason, str(error))
        self.schedule.polled(poll, _now(), answered=False)

    def unsteady(self, poll: Poll, error: Unsteady) -> None:
        """The device is well, but what it says is not believed: again in its turn, or bad."""
        if poll.tries < poll.device.timing.retries:
            self.schedule.again(poll)
            return
        poll.forget(_now())
        self.bad(poll.block.tags, Reason.GARBLED, str(error))
        self.schedule.polled(poll, _now())

    def refused(self, poll: Poll, error: Refused) -> None:
        """A poll was refused: asked again, halved to find the culprit, or its tags are bad."""
        device, block = poll.device, poll.block
        device.record.refusals[error.code] += 1
        if error.refusal is Refusal.DAMAGED and poll.tries < device.timing.retries:
            self.schedule.again(poll)
            return
        if error.refusal is Refusal.BUSY and poll.tries < device.timing.retries:
            self.schedule.again(poll, _now() + BUSY_PAUSE * 2**poll.tries)
            return
        if block.listed:
            self._unlisted(poll, error)
            return
        if error.refusal is Refusal.ADDRESS and poll.seen and not poll.tries:
            self.schedule.again(poll)  # it was there: noise can make a request another one
            return
        if error.refusal is Refusal.ADDRESS:
            halves = device.refusals.refused(block, self.wall(), error.code)
            if halves:
                self.schedule.replace(poll, halves, _now())
                return
            log.warning(
                "address refused", device=device.name, block=describe(poll.block), why=str(error)
            )
        poll.forget(_now())
        self.bad(block.tags, Reason.REFUSED, str(error))
        self.schedule.polled(poll, _now())
        self._settle(device)

    def _unlisted(self, poll: Poll, error: Refused) -> None:
        """A list was refused: the device forgot it, or it names an address that is not there."""
        if poll.tries < 1:
            self.schedule.again(poll)
            return
        log.warning("no list any more", device=poll.device.name, why=str(error))
        poll.device.lists = False
        self._replan(poll.device)

    def hasten(self, device: Device, tag: Tag) -> None:
        """Read the tag's block before all other polls."""
        poll = self.schedule.reader(device, tag)
        if poll is not None:
            self.schedule.hasten(poll)

    def bad(self, tags: Sequence[Tag], reason: Reason, detail: str) -> None:
        now = self.wall()
        self.upstairs.samples([bad(tag, reason, now, detail) for tag in tags])

    def line_down(self, why: str) -> None:
        self.overdue.stop()
        for device in self.schedule.devices:
            device.start(LineDown(why))
            self.upstairs.alive(device, False)
            self.bad(device.tags, Reason.LINE_DOWN, why)

    def line_up(self) -> None:
        """Every device is to be heard anew; a doubt from before the loss stays."""
        for device in self.schedule.devices:
            device.start()
        self.schedule.opened(_now())

    def _settle(self, device: Device) -> None:
        if device.refusals.settle():
            device.lists = True  # what a list was refused for may be known now
            self._replan(device)

    def _replan(self, device: Device) -> None:
        device.refusals.abandon()
        device.plan()
        self.schedule.plan(device, _now())


def _now() -> float:
    return asyncio.get_running_loop().time()
