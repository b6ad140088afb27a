"""Shortens the silence before polls in steps, as far as no reply is lost."""

import math
from collections.abc import Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.device.station_silence import MOST_DOUBLED
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import Idle, Job, Poll, Reopen, Result, Traffic, Transacted
from gateway.engine.jobs.poll_entry import PollEntry
from gateway.engine.results.rule import Rule
from gateway.engine.results.unsolicited import speaks
from gateway.engine.schedule.in_flight import InFlight
from gateway.errors import Garbled, NoReply, Refusal, Refused

PROOF = 50  # replies for each station at one step, without a loss, before the next step
HELD = 10_000  # replies at the last step after which earlier losses count no more
PAUSE = 60.0  # seconds of safe silences after a loss; doubled after each


class Pace(NamedTuple):
    """The speed of learning; the simulation learns sooner than a plant."""

    needed: float = 0.5  # share of the wire time for polls; below it, nothing is gained
    proof: int = PROOF
    pause: float = PAUSE


class ShorterSilences(Rule):
    """The silences of one line, between a reply and the next poll.

    A station may need a silence for two reasons. It still drives the pair after its own reply: this
    damages the next request on the line. Or it does not listen yet after any frame: this
    loses the requests to itself only. So the silence before a poll is the longer one of two: of the
    station that replied just before, and of the station that gets the poll. All others may miss a
    request that is not for them.

    All silences of the line are halved in steps while the polls need much of its time. The first
    poll without a good reply after a shorter silence brings all safe ones back. If the device
    replies to the next request, the silence was too short: its two stations do not get it for an
    hour, then for two, and so on, and the line pauses for a minute, then for two, and so on.

    Only a poll after a good poll gets a shorter silence: no write, command, probe or resync, no
    repeated poll, and none whose reply could not be told from a copy of the reply before.
    """

    def __init__(
        self, line: str, devices: Sequence[Device], in_flight: InFlight, effects: Effects
    ) -> None:
        self._in_flight, self._tell = in_flight, partial(effects.info, line=line)
        self._devices = devices
        self._learning = _learning(devices)
        self.pace = Pace()
        self.prepares = False
        self.step = 0  # so many times the safe silences are halved
        self.answered = 0  # polls at this step, after its silence
        self.look_at = float(PROOF) if self._learning else math.inf
        self.spoke: Device | None = None  # its good reply to a poll is the last frame on the wire
        # A request was lost to the first, perhaps because of the second, after so many seconds.
        self.suspects: tuple[tuple[Device, ...], float] | None = None
        self._held = 0  # polls at shorter silences without a loss
        self._losses = 0
        self._next = -math.inf  # when the next step may be taken
        self._shape: Hashable = None  # of the last reply to a poll; None: unknown

    def applies(self, devices: Sequence[Device]) -> bool:
        return bool(_learning(devices))

    def before(self, job: Job, now: float) -> None:
        """Sets the silence before the requests of the job."""
        if self.suspects:
            self.judge(now)
        self.prepares = bool(self.step or self.suspects)
        if not self.step or isinstance(job, Idle | Reopen):
            return
        entry = self._in_flight.open.get(job) if isinstance(job, Poll) else None
        device, spoke = job.device, self.spoke
        silence = device.silence
        silence.keep_safe(at_rest=False)
        if entry is None:
            self.spoke = None
            return
        shape = None if device.shapes is None else device.shapes.last
        copied = spoke is device and self._shape in (None, shape)
        self._shape = shape
        if spoke is not None and not copied and _may_be_lost(entry):
            silence.keep(max(silence.shorter, spoke.silence.shorter))

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Counts the polls at this step, and notes the station that spoke last."""
        if isinstance(job, Poll):
            device = job.device
            if not isinstance(result, Exception):
                self.spoke = device
                if traffic.silence < device.silence.tested_below:
                    self.answered += 1
                    if self.answered >= self.look_at:
                        self.look(now)
                return
            self.failed(device, result, traffic.silence, now)
        self.spoke = None

    def look(self, now: float) -> None:
        """Takes the next step, if the replies are enough and the polls need it."""
        online = sum(device.health.online for device in self._learning)
        self.look_at = self.pace.proof * max(1, online)
        if self.answered < self.look_at:
            return
        self.answered, self._held = 0, self._held + self.answered
        if self._at_last_step:
            self._hold(now)
            return
        if self.suspects or now < self._next:
            return
        if sum(device.load for device in self._devices) < self.pace.needed:
            return
        self.step += 1
        self.prepares = True
        self.spoke = None
        for device in self._devices:
            device.silence.take_step(self.step, now)
            device.silence.keep_safe(at_rest=False)
        shortest = min(device.silence.shorter for device in self._learning)
        self._tell("silences shortened", shortest=shortest)

    def _hold(self, now: float) -> None:
        before = [device.silence.shorter for device in self._learning]
        for device in self._learning:
            device.silence.take_step(self.step, now)
        if before != [device.silence.shorter for device in self._learning]:
            self._held = 0  # a silence that was too short is tried again
        elif self._held >= HELD:
            self._losses = 0
            for device in self._learning:
                device.silence.held(now)

    @property
    def _at_last_step(self) -> bool:
        return all(d.silence.safe / 2**self.step <= d.silence.least for d in self._learning)

    def failed(self, device: Device, result: object, silence: float, now: float) -> None:
        """Takes a poll without values, whose request followed so many seconds of silence."""
        match result:
            case NoReply() | Garbled() | Refused(refusal=Refusal.DAMAGED):
                pass
            case _:
                return  # the request arrived
        self.answered = 0
        if self.step and silence < device.silence.safe:
            near = (device,) if self.spoke in (None, device) else (device, self.spoke)
            self.suspects, self.prepares = (near, silence), True
            self._restore(str(result), now)

    def judge(self, now: float) -> None:
        """Decides if a silence was too short: the device replies to the next request.

        If the device is offline instead, the silence was not the reason.
        """
        if self.suspects is None or self.suspects[0][0].state is State.FAILING:
            return
        (device, *_), silence = self.suspects
        if device.state is State.ONLINE:
            for times, each in enumerate(self.suspects[0], 1):  # not both are tried together
                if each.silence.learns:
                    each.silence.was_too_short(silence, now, times)
            self._pause(now)
        self.suspects = None

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes that answer no request."""
        self._disturbed(now)

    def unmatched(self, device: Device, frame: Any, now: float, time: int, *, echo: bool) -> None:
        """Takes a frame that answers no request."""
        if not echo:
            self._disturbed(now)

    def _disturbed(self, now: float) -> None:
        """Restores the silences: they let such bytes pass."""
        self.answered = 0
        if self.step:
            self._restore("bytes arrived that answer no request", now)
            self._pause(now)

    def opened(self, now: float) -> None:
        """Starts again with the safe silences, because the port was opened."""
        self.suspects = None
        if self.step:
            self._restore("the port was opened", now)

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Takes over changed devices of the line, which are in `devices` already."""
        self.suspects = self.spoke = self._shape = None
        if self.step:
            self._restore("the devices of the line changed", now)
        self._learning = _learning(self._devices)
        self.look_at = float(self.pace.proof) if self._learning else math.inf

    def _pause(self, now: float) -> None:
        """Tries no shorter silence for a while, longer after each loss."""
        self._next = now + self.pace.pause * 2**self._losses
        self._losses = min(self._losses + 1, MOST_DOUBLED)

    def _restore(self, why: str, now: float) -> None:
        self.step = self.answered = self._held = 0
        self.spoke = self._shape = None
        self.look_at = self.pace.proof
        for device in self._devices:
            device.silence.take_step(0, now)
            device.silence.keep_safe(at_rest=True)
        self._tell("silences restored", why=why)


def _learning(devices: Sequence[Device]) -> list[Device]:
    """Returns the devices whose silences may be shortened."""
    if any(map(speaks, devices)):
        return []  # the silence lets their frames begin
    return [device for device in devices if device.silence.learns]


def _may_be_lost(poll: PollEntry) -> bool:
    """Returns True for the poll of a device in order, whose loss costs one repeated poll."""
    device = poll.device
    return (
        device.state is State.ONLINE
        and not device.health.needs_resync
        and not (poll.tries or poll.missed or poll.job.register)
        and device.settings.verify_reads == 1
        and device.timing.retries > 0
    )
