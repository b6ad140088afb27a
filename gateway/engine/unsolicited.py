"""What devices say unasked on one line: bytes in, samples up, answers back.

A line that has no such device never comes here but for one look at an empty table.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import structlog

from gateway.engine.device import Device
from gateway.engine.jobs import Idle
from gateway.engine.results import Consequences
from gateway.errors import BadValue, Garbled
from gateway.line.transaction import Turn
from gateway.protocols.driver import Talk
from gateway.protocols.unsolicited import (
    Stale,
    Unsolicited,
    UnsolicitedEvent,
    UnsolicitedFrame,
    UnsolicitedListener,
)
from gateway.tags import Reason, Sample, Tag, bad, of_field

log = structlog.get_logger("gateway.line")
ANSWER_WITHIN = 1.0  # seconds; whoever waited longer has given up
MOST_ANSWERS = 16  # waiting
HELD_FOR = 1.0  # seconds that a frame which does not end may keep the line from everybody else


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a device waits for that spoke unasked. `until`: by the loop's clock."""

    device: Device
    frame: Any
    until: float

    async def give(self, talk: Talk[Any]) -> None:
        try:
            await talk.tell(self.frame)
        except Garbled as error:
            log.warning("not answered", device=self.device.name, why=str(error))


@dataclass(slots=True, eq=False)
class _Speaker:
    """A device that speaks unasked, and the tags that it speaks of."""

    device: Device
    listener: UnsolicitedListener
    unsolicited: Collection[str]
    tags: dict[str, list[Tag]] = field(default_factory=dict)  # by field
    understood: bool = True  # the last it said
    unread: set[str] = field(default_factory=set)  # fields that the last frame with them spoilt

    def __post_init__(self) -> None:
        for tag in self.device.tags:
            name = self.device.driver.spell(tag.address)
            if name in self.unsolicited:
                self.tags.setdefault(name, []).append(tag)


def listened(device: Device) -> list[Tag]:
    """Its tags whose values come unasked and in no other way."""
    driver = device.driver
    if not isinstance(driver, Unsolicited):
        return []
    return [tag for tag in device.tags if driver.unsolicited_only(tag.span)]


class Listening:
    """The listeners of one line. Never waits, never speaks on the wire."""

    def __init__(self, devices: Sequence[Device], then: Consequences) -> None:
        self._devices = devices
        self._then = then
        self._speakers: list[_Speaker] = []
        self._answers: deque[Answer] = deque(maxlen=MOST_ANSWERS)
        self._echo = b""  # of what was told, still on its way back
        self._held_since: float | None = None

    def opened(self, now: float) -> None:
        """The port was opened: a frame may be on its way already."""
        self._answers.clear()
        self._echo, self._held_since = b"", None
        self._speakers = [
            _Speaker(device, device.driver.listener(now), device.driver.unsolicited)
            for device in self._devices
            if isinstance(device.driver, Unsolicited) and device.driver.sends_unsolicited
        ]

    def received(self, data: bytes, now: float) -> None:
        """Bytes that nobody had asked for."""
        if self._echo:
            data = self._without_echo(data)
        for speaker in self._speakers:
            self._take(speaker, speaker.listener.received(data, now), now)

    def beside(self, device: Device) -> Callable[[Any], None] | None:
        """For what it says in a conversation with it, and is no answer."""
        for speaker in self._speakers:
            if speaker.device is device:
                return partial(self._beside, speaker)
        return None

    def _beside(self, speaker: _Speaker, frame: Any) -> None:
        now = _now()
        self._take(speaker, speaker.listener.unmatched(frame, now), now)

    def ended(self, device: Device, turn: Turn) -> None:
        """A conversation is over: what was half heard before it is void."""
        self._echo = turn.unreturned
        for speaker in self._speakers:
            if turn.heard or (turn.sent and speaker.device is not device):
                speaker.listener.restart(_now())

    @property
    def due(self) -> float:
        """When `next` has something to do though nothing was heard."""
        return min(
            (due for each in self._speakers if (due := each.listener.due) is not None),
            default=float("inf"),
        )

    def next(self, now: float) -> Answer | Idle | None:
        """What goes before all other jobs: an answer, or not to speak into a frame."""
        if not self._speakers:
            return None
        for speaker in self._speakers:
            if (due := speaker.listener.due) is not None and due <= now:
                self._take(speaker, speaker.listener.tick(now), now)
        while self._answers:
            answer = self._answers.popleft()
            if now < answer.until:
                return answer
            log.warning("too late to answer", device=answer.device.name)
        until = self._busy_until(now)
        return None if until is None else Idle(until)

    def _busy_until(self, now: float) -> float | None:
        until = max((each.listener.busy_until or 0.0 for each in self._speakers), default=0.0)
        if until <= now:
            self._held_since = None
            return None
        if self._held_since is None:
            self._held_since = now
        end = min(until, self._held_since + HELD_FOR)
        return end if now < end else None

    def _without_echo(self, data: bytes) -> bytes:
        """Our own words, which a two-wire adapter hands back, were said by nobody else."""
        size = min(len(data), len(self._echo))
        if data[:size] == self._echo[:size]:
            self._echo = self._echo[size:]
            return data[size:]
        self._echo = b""
        return data

    def _take(self, speaker: _Speaker, said: Iterable[UnsolicitedEvent], now: float) -> None:
        for one in said:
            match one:
                case UnsolicitedFrame():
                    self._heard(speaker, one, now)
                case Garbled():
                    self._garbled(speaker, one)
                case Stale(fields):
                    self._stale(speaker, fields)

    def _heard(self, speaker: _Speaker, heard: UnsolicitedFrame, now: float) -> None:
        device, time = speaker.device, self._then.wall()
        device.record.heard += 1
        speaker.understood = True
        if device.broadcast:  # who is asked too must answer to be believed alive
            device.trouble = None
            self._then.answered(device)
        self._look_over(speaker, heard)
        samples = [
            of_field(tag, value, time)
            for name, value in heard.values.items()
            for tag in speaker.tags.get(name, ())
        ]
        self._tell(samples)
        if heard.reply is not None:
            self._answer(speaker, heard.reply, now)

    def _look_over(self, speaker: _Speaker, heard: UnsolicitedFrame) -> None:
        """Count the fields that could not be read; told are those that could before."""
        for name, value in heard.values.items():
            if not isinstance(value, Garbled):
                speaker.unread.discard(name)
                continue
            speaker.device.record.failures[value.evidence] += 1
            if name not in speaker.unread:
                speaker.unread.add(name)
                self._note(speaker.device, value)

    def _garbled(self, speaker: _Speaker, damage: Garbled) -> None:
        device = speaker.device
        if device.broadcast:
            device.trouble = damage
        if speaker.understood:  # what does not end is told once
            self._note(device, damage)
        speaker.understood = False
        device.record.failures[damage.evidence] += 1
        self._bad(speaker, speaker.tags, Reason.GARBLED, str(damage))

    def _stale(self, speaker: _Speaker, fields: Iterable[str]) -> None:
        device = speaker.device
        self._bad(speaker, fields, Reason.NO_REPLY, "not heard for longer than its stale_after")
        if device.broadcast and speaker.listener.all_stale and device.served:
            device.start()
            self._then.upstairs.alive(device, False)
            log.warning("device silent", device=device.name)

    def _answer(self, speaker: _Speaker, frame: Any, now: float) -> None:
        try:
            speaker.device.driver.codec().encode(frame)
        except BadValue as error:
            log.warning("not answered", device=speaker.device.name, why=str(error))
        else:
            self._answers.append(Answer(speaker.device, frame, now + ANSWER_WITHIN))

    def _bad(self, speaker: _Speaker, fields: Iterable[str], reason: Reason, detail: str) -> None:
        time = self._then.wall()
        self._tell(
            [
                bad(tag, reason, time, detail)
                for name in fields
                for tag in speaker.tags.get(name, ())
            ]
        )

    def _tell(self, samples: Sequence[Sample]) -> None:
        if samples:
            self._then.upstairs.samples(samples)

    def _note(self, device: Device, damage: Garbled) -> None:
        log.info("not understood", device=device.name, why=str(damage), bytes=damage.data.hex(" "))


def _now() -> float:
    return asyncio.get_running_loop().time()
