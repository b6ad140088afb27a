"""Decides when devices are planned again, so that planning takes a small share of the time."""

import math

from gateway.engine.device.device import Device
from gateway.engine.schedule.schedule import Schedule

PLANNING_SHARE = 0.01  # of the time, for all devices of a line together


class ReplanBudget:
    """The devices of a line that wait for a plan. A plan of many changes is made in pieces."""

    def __init__(self, schedule: Schedule) -> None:
        self.next_at = math.inf  # when `look` makes the next plan
        self.allowed_from = -math.inf  # when the share of planning permits another plan
        self._schedule = schedule
        self._waiting: dict[Device, float] = {}  # since when a plan may be made

    def want(self, device: Device, now: float, after: float = 0.0) -> None:
        """Plans the device in `after` seconds, or when earlier plans allow it."""
        when = now + after
        self._waiting[device] = min(when, self._waiting.get(device, when))
        self.look(now)

    def forget(self, device: Device) -> None:
        """Forgets a device that the line no longer has."""
        self._waiting.pop(device, None)

    def look(self, now: float) -> None:
        """Makes the next plan if its time has come."""
        self.next_at = math.inf
        if not self._waiting:
            return
        device = min(self._waiting, key=self._waiting.__getitem__)
        due = max(self._waiting[device], self.allowed_from)
        if now < due:
            self.next_at = due
            return
        device.bad_addresses.abandon()
        if device.monitor.again <= now:
            device.monitor.allow()
        self.spent(device.plan_changes(), now)
        self._schedule.plan(device, now)
        if not device.bad_addresses.changed:
            self._waiting[device] = device.monitor.again
            if device.monitor.again == math.inf:
                del self._waiting[device]
        self.look(now)

    def spent(self, seconds: float, now: float) -> None:
        """Allows the next plan so late that all plans of the line keep to their share."""
        self.allowed_from = now + seconds / PLANNING_SHARE
