"""Bit writes: the device changes bits of a word by itself, where it has the function for it."""

from collections.abc import Sequence

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Job, Result, Sent, Traffic, Transacted
from gateway.engine.jobs.requests import Write
from gateway.engine.results.rule import Rule
from gateway.errors import NoReply, Refusal, Refused
from gateway.protocols.capabilities import ChangesBits

LACKED_FOR = 3600.0  # seconds until a device that lacks the function is tried again


class BitWrites(Rule):
    """The devices that change bits by themselves, learned from their replies.

    Otherwise the gateway reads the word, changes the bits and writes it: other bits that the device
    changes in between are lost. So each device is tried. One that refuses, or was silent about one
    before any was done, is tried again after `LACKED_FOR`. A refused write is sent again the other
    way, because it was not done.
    """

    always = False

    def __init__(self) -> None:
        self._lacked_until: dict[Device, float] = {}
        self._proven: set[Device] = set()

    def applies(self, devices: Sequence[Device]) -> bool:
        return any(isinstance(device.driver, ChangesBits) for device in devices)

    def before(self, job: Job, now: float) -> None:
        if isinstance(job, Write) and job.tag.part is not None:
            driver, device = job.device.driver, job.device
            may = isinstance(driver, ChangesBits) and driver.changes_bits(job.tag.span)
            known = self._lacked_until.get(device, 0.0) <= now
            job.mask(masked=may and known and not job.refused)

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        if not (isinstance(job, Write) and job.masked):
            return
        match result:
            case Sent():
                self._proven.add(job.device)
            case Refused(unexecuted=True, refusal=Refusal.OTHER):
                self._lacked_until[job.device] = now + LACKED_FOR
            case NoReply() if job.device in self._proven:  # once may be noise
                self._proven.discard(job.device)
            case NoReply():
                self._lacked_until[job.device] = now + LACKED_FOR

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        changes.carry(self._lacked_until)
        changes.exchange(self._proven)
