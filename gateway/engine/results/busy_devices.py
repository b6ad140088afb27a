"""A busy device is left alone: each request would only keep it busy."""

from typing import NamedTuple

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Result, Settled, Traffic, Transacted
from gateway.engine.results.rule import Rule
from gateway.errors import BadValue, Busy, LineDown, Refusal, Refused, Unclear

SEVERAL = 2  # busy replies in a row; one alone may be chance
FIRST, LONGEST = 2.0, 60.0  # seconds without polls, doubled with each busy reply


class _Busy(NamedTuple):
    replies: int  # in a row
    until: float


class BusyDevices(Rule):
    """A device that replies *busy* twice in a row is not polled for two seconds, then for four, up
    to a minute. After any other reply it is polled as usual."""

    always = False

    def __init__(self) -> None:
        self._busy: dict[Device, _Busy] = {}

    def free(self, device: Device, now: float) -> float:
        found = self._busy.get(device)
        return now if found is None else found.until

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        if not (self._busy or isinstance(result, Refused)):
            return
        match result:
            case Refused(refusal=Refusal.BUSY):
                before = self._busy.get(job.device)
                replies = 1 if before is None else before.replies + 1
                pause = FIRST * 2.0 ** min(replies - SEVERAL, 10) if replies >= SEVERAL else 0.0
                self._busy[job.device] = _Busy(replies, now + min(pause, LONGEST))
            case Unclear() | LineDown() | BadValue() | Busy() | Settled() | None:
                pass  # no reply
            case _:
                self._busy.pop(job.device, None)

    def opened(self, now: float) -> None:
        self._busy.clear()

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        changes.carry(self._busy)
