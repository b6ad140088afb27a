"""Broadcast replies: some stations reply to a broadcast, against the standard."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.jobs.jobs import Poll, Result, Sent, Traffic, Transacted
from gateway.engine.jobs.requests import Command
from gateway.engine.results.rule import Rule


class BroadcastReplies(Rule):
    """A late reply to a broadcast never acknowledges the next write.

    While it may still arrive, a write to any station that heard the broadcast has a resync after
    it, which shows if another reply than its own arrived.
    """

    def __init__(self, devices: Sequence[Device]) -> None:
        self._devices = devices

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        if isinstance(job, Poll) or not traffic.sent:
            return
        to_all = job.broadcast if isinstance(job, Command) else job.device.broadcast
        if not to_all or (isinstance(result, Sent) and result.acknowledged):
            return
        for device in self._devices:
            if device.shapes is not None:
                device.shapes.told_all(now + device.longest_reply)
