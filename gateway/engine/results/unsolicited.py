"""Unsolicited frames of one line: bytes in, samples and replies out."""

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import Answer, Idle, Result, Traffic, Transacted
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.rule import NEVER, Rule
from gateway.errors import BadValue, Garbled, log_fields
from gateway.protocols.unsolicited import (
    Stale,
    Unsolicited,
    UnsolicitedEvent,
    UnsolicitedFrame,
    UnsolicitedListener,
)
from gateway.tags import Reason, Tag, of_field

REPLY_WITHIN = 1.0  # seconds; after that the device no longer waits
MOST_REPLIES = 16  # waiting
HELD_FOR = 1.0  # seconds that an incomplete frame may hold up the line


@dataclass(slots=True, eq=False)
class _Sender:
    """A device that sends unsolicited frames, and the tags of its fields."""

    device: Device
    listener: UnsolicitedListener
    unsolicited: Collection[str]
    tags: dict[str, list[Tag]] = field(default_factory=dict)  # by field
    understood: bool = True  # its last frame was correct
    unreadable: set[str] = field(
        default_factory=set
    )  # fields that were garbled in their last frame

    def __post_init__(self) -> None:
        for tag in self.device.tags:
            name = self.device.driver.spell(tag.address)
            if name in self.unsolicited:
                self.tags.setdefault(name, []).append(tag)

    def note(self, *, understood: bool) -> None:
        """Notes if the last frame was correct."""
        self.understood = understood

    def tags_of(self, fields: Iterable[str]) -> list[Tag]:
        return [tag for name in fields for tag in self.tags.get(name, ())]


def _senders(device: Device, now: float) -> list[_Sender]:
    """Returns the sender of the device, if it sends unsolicited frames."""
    driver = device.driver
    if not (isinstance(driver, Unsolicited) and driver.sends_unsolicited):
        return []
    return [_Sender(device, driver.listener(now), driver.unsolicited)]


def speaks(device: Device) -> bool:
    """Returns True for a device that sends unsolicited frames."""
    driver = device.driver
    return isinstance(driver, Unsolicited) and driver.sends_unsolicited


class UnsolicitedFrames(Rule):
    """The listeners of one line: one for each device that sends unsolicited frames."""

    def __init__(self, devices: Sequence[Device], results: HealthRules, effects: Effects) -> None:
        self.speakers: list[_Sender] = []
        self._devices = devices
        self._results = results
        self._effects = effects
        self._replies: deque[Answer] = deque(maxlen=MOST_REPLIES)
        self._held_since: float | None = None

    def applies(self, devices: Sequence[Device]) -> bool:
        return any(map(speaks, devices))

    def opened(self, now: float) -> None:
        """Starts the listeners. The port may have been opened in the middle of a frame."""
        self._replies.clear()
        self._held_since = None
        self.speakers = [sender for one in self._devices for sender in _senders(one, now)]

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Takes over changed devices. A listener goes on: it knows the ages of the fields."""
        following = dict(changes.replaced)
        stay = []
        for sender in self.speakers:
            if (new := following.get(sender.device)) is not None:
                stay.append(replace(sender, device=new, tags={}))
            elif sender.device not in changes.removed:
                stay.append(sender)
        self.speakers = stay + [s for device in changes.added for s in _senders(device, now)]
        left = changes.left
        kept = [reply for reply in self._replies if reply.device not in left]
        self._replies.clear()
        self._replies.extend(kept)

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes that arrived outside of a transaction."""
        for sender in self.speakers:
            self._apply(sender, sender.listener.received(data, now), now, time)

    def unmatched(self, device: Device, frame: Any, now: float, time: int, *, echo: bool) -> None:
        """Takes a frame that arrived in a transaction with this device and is not its reply.

        It can be an unsolicited frame of another device with the same framing.
        """
        for sender in self.speakers:
            if sender.device is device or sender.listener.framed_as(device.driver):
                self._apply(sender, sender.listener.unmatched(frame, now), now, time)

    def concluded(
        self, job: Transacted, result: Result, traffic: Traffic, now: float, time: int
    ) -> None:
        """Drops incomplete frames that began before the transaction."""
        replied = traffic.exchanges and not isinstance(result, Exception)
        whole = bool(replied) and not (traffic.strange or traffic.extra)
        for sender in self.speakers:
            if traffic.heard or (traffic.sent and sender.device is not job.device):
                alike = sender.listener.framed_as(job.device.driver)
                sender.listener.restart(now, whole=whole and alike)

    @property
    def due(self) -> float:
        """The time at which `tick` must be called if no byte arrives."""
        dues = (due for each in self.speakers if (due := each.listener.due) is not None)
        return min(dues, default=NEVER)

    def tick(self, now: float, time: int) -> None:
        """Lets silence end frames, and turns old fields stale."""
        for sender in self.speakers:
            if (due := sender.listener.due) is not None and due <= now:
                self._apply(sender, sender.listener.tick(now), now, time)

    def first(self, now: float) -> Answer | Idle | None:
        """Returns a job that precedes all others: a reply, or `Idle` during a frame."""
        while self._replies:
            reply = self._replies.popleft()
            if now < reply.until:
                return reply
            self._effects.warning(
                "reply dropped", device=reply.device.name, why="the line was busy too long"
            )
        until = self._busy_until(now)
        return None if until is None else Idle(until)

    def _busy_until(self, now: float) -> float | None:
        until = max((each.listener.busy_until or 0.0 for each in self.speakers), default=0.0)
        if until <= now:
            self._held_since = None
            return None
        if self._held_since is None:
            self._held_since = now
        end = min(until, self._held_since + HELD_FOR)
        return end if now < end else None

    def _apply(
        self, sender: _Sender, events: Iterable[UnsolicitedEvent], now: float, time: int
    ) -> None:
        for event in events:
            match event:
                case UnsolicitedFrame():
                    self._understood(sender, event, now, time)
                case Garbled():
                    self._garbled(sender, event, time)
                case Stale(fields):
                    self._stale(sender, fields, time)

    def _understood(self, sender: _Sender, frame: UnsolicitedFrame, now: float, time: int) -> None:
        device = sender.device
        device.record.count_unsolicited()
        sender.note(understood=True)
        if device.broadcast:  # a device that is polled must reply to count as online
            device.health.understood()
            self._results.answered(device, now, time)
        self._count_unreadable(sender, frame)
        samples = [
            of_field(tag, value, time)
            for name, value in frame.values.items()
            for tag in sender.tags.get(name, ())
        ]
        if samples:
            self._effects.samples(samples)
        if frame.reply is not None:
            self._queue_reply(device, frame.reply, now)

    def _count_unreadable(self, sender: _Sender, frame: UnsolicitedFrame) -> None:
        """Counts garbled fields. Logs a field that was correct before."""
        for name, value in frame.values.items():
            if not isinstance(value, Garbled):
                sender.unreadable.discard(name)
                continue
            sender.device.record.count_failure(value)
            if name not in sender.unreadable:
                sender.unreadable.add(name)
                self._log("field garbled", sender.device, value)

    def _garbled(self, sender: _Sender, damage: Garbled, time: int) -> None:
        device = sender.device
        if device.broadcast:
            device.health.not_understood(damage)
        if sender.understood:  # repeated damage is logged once
            self._log("frame garbled", device, damage)
        sender.note(understood=False)
        device.record.count_failure(damage)
        self._bad(sender, sender.tags, Reason.GARBLED, str(damage), time)

    def _stale(self, sender: _Sender, fields: Iterable[str], time: int) -> None:
        device = sender.device
        detail = "not received for longer than its stale_after"
        self._bad(sender, fields, Reason.NO_REPLY, detail, time)
        if device.broadcast and sender.listener.all_stale and device.health.online:
            device.restart()
            self._effects.online(device, False)
            self._effects.warning("device offline", device=device.name, why=detail)

    def _queue_reply(self, device: Device, frame: Any, now: float) -> None:
        try:
            device.driver.codec().encode(frame)
        except BadValue as error:
            self._effects.warning("reply dropped", device=device.name, why=str(error))
        else:
            self._replies.append(Answer(device, frame, now + REPLY_WITHIN))

    def _bad(
        self, sender: _Sender, fields: Iterable[str], reason: Reason, detail: str, time: int
    ) -> None:
        if tags := sender.tags_of(fields):
            self._effects.bad(tags, reason, time, detail)

    def _log(self, event: str, device: Device, damage: Garbled) -> None:
        self._effects.info(event, device=device.name, **log_fields(damage))
