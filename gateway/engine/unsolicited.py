"""Unsolicited frames of one line: bytes in, samples out, replies back."""

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.engine.device import Device
from gateway.engine.effects import Effects
from gateway.engine.jobs import Answer, Idle
from gateway.engine.results import Results
from gateway.errors import BadValue, Garbled
from gateway.protocols.unsolicited import (
    Stale,
    Unsolicited,
    UnsolicitedEvent,
    UnsolicitedFrame,
    UnsolicitedListener,
)
from gateway.tags import Reason, Tag, of_field

REPLY_WITHIN = 1.0  # seconds; a device that waited longer has given up
MOST_REPLIES = 16  # waiting
HELD_FOR = 1.0  # seconds that an incomplete frame may keep the line from all others
NEVER = float("inf")


@dataclass(slots=True, eq=False)
class _Speaker:
    """A device that sends unsolicited frames, and the tags of its fields."""

    device: Device
    listener: UnsolicitedListener
    unsolicited: Collection[str]
    tags: dict[str, list[Tag]] = field(default_factory=dict)  # by field
    understood: bool = True  # its last frame was
    unreadable: set[str] = field(default_factory=set)  # fields, in the last frame with them

    def __post_init__(self) -> None:
        for tag in self.device.tags:
            name = self.device.driver.spell(tag.address)
            if name in self.unsolicited:
                self.tags.setdefault(name, []).append(tag)

    def tags_of(self, fields: Iterable[str]) -> list[Tag]:
        return [tag for name in fields for tag in self.tags.get(name, ())]


def unsolicited_tags(device: Device) -> list[Tag]:
    """The tags whose values arrive unsolicited and in no other way."""
    driver = device.driver
    if not isinstance(driver, Unsolicited):
        return []
    return [tag for tag in device.tags if driver.unsolicited_only(tag.span)]


class UnsolicitedFrames:
    """The listeners of one line. A line without a device that speaks unsolicited has none."""

    def __init__(self, devices: Sequence[Device], results: Results, effects: Effects) -> None:
        self.speakers: list[_Speaker] = []
        self._devices = devices
        self._results = results
        self._effects = effects
        self._replies: deque[Answer] = deque(maxlen=MOST_REPLIES)
        self._held_since: float | None = None

    def opened(self, now: float) -> None:
        """The port was opened, perhaps in the middle of a frame."""
        self._replies.clear()
        self._held_since = None
        self.speakers = [
            _Speaker(device, device.driver.listener(now), device.driver.unsolicited)
            for device in self._devices
            if isinstance(device.driver, Unsolicited) and device.driver.sends_unsolicited
        ]

    def received(self, data: bytes, now: float, time: int) -> None:
        """Bytes that arrived outside of a transaction."""
        for speaker in self.speakers:
            self._apply(speaker, speaker.listener.received(data, now), now, time)

    def unmatched(self, device: Device, frame: Any, now: float, time: int) -> None:
        """A frame that arrived during a transaction with this device and is not its reply."""
        for speaker in self.speakers:
            if speaker.device is device:
                self._apply(speaker, speaker.listener.unmatched(frame, now), now, time)

    def transaction_ended(self, device: Device, now: float, *, sent: int, heard: int) -> None:
        """An incomplete frame from before is void."""
        for speaker in self.speakers:
            if heard or (sent and speaker.device is not device):
                speaker.listener.restart(now)

    @property
    def due(self) -> float:
        """When `tick` must be called, though nothing was received."""
        dues = (due for each in self.speakers if (due := each.listener.due) is not None)
        return min(dues, default=NEVER)

    def tick(self, now: float, time: int) -> None:
        """Time has passed: silence ends frames, and fields turn stale."""
        for speaker in self.speakers:
            if (due := speaker.listener.due) is not None and due <= now:
                self._apply(speaker, speaker.listener.tick(now), now, time)

    def next(self, now: float) -> Answer | Idle | None:
        """The job that goes before all others: a reply, or to stay quiet during a frame."""
        while self._replies:
            reply = self._replies.popleft()
            if now < reply.until:
                return reply
            self._effects.warning(
                "reply dropped", device=reply.device.name, why="the line was busy for too long"
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
        self, speaker: _Speaker, events: Iterable[UnsolicitedEvent], now: float, time: int
    ) -> None:
        for event in events:
            match event:
                case UnsolicitedFrame():
                    self._understood(speaker, event, now, time)
                case Garbled():
                    self._garbled(speaker, event, time)
                case Stale(fields):
                    self._stale(speaker, fields, time)

    def _understood(
        self, speaker: _Speaker, frame: UnsolicitedFrame, now: float, time: int
    ) -> None:
        device = speaker.device
        device.record.count_unsolicited()
        speaker.understood = True
        if device.broadcast:  # a device that is polled must reply to count as online
            device.health.understood()
            self._results.answered(device, now, time)
        self._count_unreadable(speaker, frame)
        samples = [
            of_field(tag, value, time)
            for name, value in frame.values.items()
            for tag in speaker.tags.get(name, ())
        ]
        if samples:
            self._effects.samples(samples)
        if frame.reply is not None:
            self._queue_reply(device, frame.reply, now)

    def _count_unreadable(self, speaker: _Speaker, frame: UnsolicitedFrame) -> None:
        """Fields that could be read before are logged."""
        for name, value in frame.values.items():
            if not isinstance(value, Garbled):
                speaker.unreadable.discard(name)
                continue
            speaker.device.record.count_failure(value)
            if name not in speaker.unreadable:
                speaker.unreadable.add(name)
                self._log("field garbled", speaker.device, value)

    def _garbled(self, speaker: _Speaker, damage: Garbled, time: int) -> None:
        device = speaker.device
        if device.broadcast:
            device.health.not_understood(damage)
        if speaker.understood:  # damage after damage is logged once
            self._log("frame garbled", device, damage)
        speaker.understood = False
        device.record.count_failure(damage)
        self._bad(speaker, speaker.tags, Reason.GARBLED, str(damage), time)

    def _stale(self, speaker: _Speaker, fields: Iterable[str], time: int) -> None:
        device = speaker.device
        detail = "not heard for longer than its stale_after"
        self._bad(speaker, fields, Reason.NO_REPLY, detail, time)
        if device.broadcast and speaker.listener.all_stale and device.health.online:
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
        self, speaker: _Speaker, fields: Iterable[str], reason: Reason, detail: str, time: int
    ) -> None:
        if tags := speaker.tags_of(fields):
            self._effects.bad(tags, reason, time, detail)

    def _log(self, event: str, device: Device, damage: Garbled) -> None:
        heard = damage.data.hex(" ")
        self._effects.info(event, device=device.name, why=str(damage), bytes=heard)
