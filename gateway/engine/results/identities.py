"""Identities: a device that is not the one of the file has no good values, and takes no writes."""

from collections.abc import Sequence

from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.identity import (
    FREE_SHARE,
    RECHECK,
    SHARE,
    SHORTEST,
    Identity,
    Verdict,
)
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import Identified, Identify, Result, Traffic, Transacted
from gateway.engine.results.rule import NEVER, Rule
from gateway.engine.schedule.in_flight import InFlight
from gateway.engine.schedule.schedule import Schedule
from gateway.errors import NoReply, Refusal, Refused, Unclear, WrongDevice
from gateway.tags import Reason


class Identities(Rule):
    """Asks the devices that have `identity` in the file which ones they are.

    Before the first value after the line was opened or the device was silent. Then once in each
    cycle of its polls, if a quarter of the time that the polls leave is enough; otherwise every ten
    seconds, in all a hundredth of the wire.
    """

    def __init__(
        self, devices: Sequence[Device], schedule: Schedule, in_flight: InFlight, effects: Effects
    ) -> None:
        self._devices = devices
        self._schedule = schedule
        self._in_flight = in_flight
        self._effects = effects

    def applies(self, devices: Sequence[Device]) -> bool:
        return any(device.identity is not None for device in devices)

    def first(self, now: float) -> Identify | None:
        for device in self._devices:
            identity, health = device.identity, device.health
            if identity is None:
                continue
            offline = health.state is State.OFFLINE
            silent = health.needs_resync and isinstance(health.trouble, NoReply)
            if offline or (silent and identity.is_usable):
                identity.doubt(now, offline=offline)
            elif not health.needs_resync and identity.due <= now:
                return _question(device)
        return None

    def wake(self, now: float) -> float:
        ready = (one for one in self._devices if not one.health.needs_resync)
        return min((one.identity.due for one in ready if one.identity is not None), default=NEVER)

    def opened(self, now: float) -> None:
        for device in self._devices:
            if device.identity is not None:
                device.identity.doubt(now)

    def free(self, device: Device, now: float) -> float:
        identity = device.identity
        return now if identity is None or identity.is_usable else max(identity.due, now)

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        device, identity = job.device, job.device.identity
        if not isinstance(job, Identify) or identity is None:
            return
        before = identity.verdict
        self._applied(device, identity, result, now)
        if identity.verdict is not before and identity.why.text:
            self._effects.warning("identity doubtful", device=device.name, why=identity.why.text)
        if identity.verdict is Verdict.WRONG is not before:
            for poll in self._schedule.polls(device):
                poll.forget(now)
            self._effects.bad(device.polled_tags, Reason.WRONG_DEVICE, time, identity.why.text)
        if not identity.takes_requests:
            for request in self._schedule.requests.withdraw(device):
                self._effects.unsent(request, wrong_device(device))

    def _applied(self, device: Device, identity: Identity, result: Result, now: float) -> None:
        match result:
            case Identified(told):
                identity.answered(told, now, self._pause(device, now))
            case Refused(refusal=Refusal.BUSY | Refusal.DAMAGED):
                identity.later(now)
            case Refused():
                identity.refused(str(result), now)
            case Unclear():
                identity.unanswered(now)

    def _pause(self, device: Device, now: float) -> float:
        """Returns the seconds until the next question, after one that was answered."""
        asked = sum(one.identity is not None for one in self._devices)
        all_asked = (now - self._in_flight.begun) * asked
        longest = max(all_asked / SHARE, RECHECK)
        free = (1.0 - sum(one.load for one in self._devices)) * FREE_SHARE
        if free * longest <= all_asked:
            return longest
        cycle = min((block.every for block in device.blocks), default=RECHECK)
        return min(max(cycle, SHORTEST, all_asked / free), longest)


def _question(device: Device) -> Identify:
    tags, shapes = device.settings.identity_tags, device.shapes
    if not tags or shapes is None:
        return Identify(device)
    return Identify(device, device.health.next_probe_token(), shapes.of(tags[-1].span))


def wrong_device(device: Device) -> WrongDevice:
    """Returns the outcome of a request that is not sent."""
    why = "" if device.identity is None else device.identity.why.text
    return WrongDevice(f"{device.name}: {why or 'its identity is not known'}; nothing was sent")
