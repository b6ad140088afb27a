"""A listen-only line: learns values from the traffic of another master, and has no job ever."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from gateway.engine.device.changes import Changes
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.effects import Effects
from gateway.engine.jobs.jobs import Idle
from gateway.engine.results.health_rules import HealthRules
from gateway.engine.results.rule import Rule
from gateway.errors import Evidence, Garbled, Unclear
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.listening import Asked, Learn, Listenable, Noise, Pairing, Told
from gateway.tags import Reason, Tag
from gateway.tags.scan import Decoder

INTERVALS = 3.0  # a tag that is not heard for so many of its intervals is too old
SHORTEST = 2.0  # seconds
MOST_READS = 1000  # different reads of a device that are kept ready
ONLY_LISTENS = "line {line} is listen-only: the gateway sends nothing on it"
UNHEARD = "not heard for {limit:g} s: does the other master read it?"
EXTRA = "two replies to one request: one of them may have been the reply to another"


def listens(devices: Sequence[Device]) -> bool:
    """Returns True for the devices of a listen-only line."""
    return any(device.settings.listen_only for device in devices)


def stale_after(tag: Tag) -> float:
    """Returns the seconds after which a learned value is too old."""
    return max(SHORTEST, INTERVALS * tag.every)


@dataclass(slots=True, eq=False)
class _Station:
    """A device, and the tags that each read of the other master holds."""

    device: Device
    driver: Listenable
    reads: dict[bytes, "_Read"] = field(default_factory=dict)  # by the bytes of the request
    last: Sequence[Tag] = ()  # learned from the last reply
    before: "_Read | None" = None  # the read of the reply before

    def read(self, asked: Asked) -> "_Read":
        found = self.reads.get(asked.content)
        if found is None:
            if len(self.reads) >= MOST_READS:
                self.reads.clear()
            found = self.reads[asked.content] = _Read(self, asked)
        return found

    def may_be_repeated(self, read: "_Read", data: Any) -> bool:
        """Notes a reply. Returns True if it equals the reply to the read before, and is news.

        A device server that repeats a reply makes one of it for the next request. Equal values at
        two places come again with the next read, and count then.
        """
        before, self.before = self.before, read
        equal = before is not None and before is not read and before.data == data
        return not read.replied(data, suspect=equal)

    def learned(self, read: "_Read") -> None:
        """Notes the read from which values were learned last."""
        self.last = read.tags


class _Read:
    """The tags in one read, and their decoder."""

    __slots__ = ("_decoder", "_learn", "data", "learned", "stale_after", "tags")

    def __init__(self, station: _Station, asked: Asked) -> None:
        self.data: Any = None  # of the last reply
        self.learned: Any = None  # of the last reply that counted
        self.tags: list[Tag] = []
        self._learn: list[Learn] = []
        begins, units = list[int](), 0
        for tag in station.device.tags:
            learn = station.driver.learn(asked.read, tag.span)
            if learn is not None:
                self.tags.append(tag)
                self._learn.append(learn)
                begins.append(units)
                units += tag.span.size
        self.stale_after = min(map(stale_after, self.tags), default=math.inf)
        self._decoder = Decoder(self.tags, begins) if self.tags else None

    def replied(self, data: Any, *, suspect: bool) -> bool:
        """Notes the data of a reply. Returns False if it is suspect, and news."""
        counts = not suspect or data in (self.learned, self.data)
        self.data = data
        if counts:
            self.learned = data
        return counts

    def samples(self, data: Any, time: int) -> Sequence[Any]:
        """Returns the samples of a reply; none if its data cannot be those of the request."""
        units: list[int] = []
        for learn in self._learn:
            found = learn(data)
            if found is None:
                return ()
            units += found
        return () if self._decoder is None else self._decoder.first(units, time)


class Listening(Rule):
    """Takes the place of `UnsolicitedFrames` on a listen-only line."""

    due = math.inf  # when `tick` must be called

    def __init__(
        self, devices: Sequence[Device], wire: WireTiming, results: HealthRules, effects: Effects
    ) -> None:
        self._speakers = devices
        self._results = results
        self._effects = effects
        self._character = wire.character
        self._stations = {
            one.driver.station: _Station(one, cast("Listenable", one.driver)) for one in devices
        }
        self._timeout = max(one.timing.reply_timeout for one in devices)
        self._last = -math.inf  # when bytes arrived
        self._heard: dict[Tag, float] = {}  # when; a tag that is stale already is missing
        self.opened(0.0)

    def opened(self, now: float) -> None:
        """Starts to listen, perhaps in the middle of a frame."""
        devices = self._speakers
        self._last = now
        self._traffic_reader = self._stations[devices[0].driver.station].driver.traffic_reader(
            self._character
        )
        self._pairing = Pairing(max(one.longest_reply for one in devices), self._character)
        self._heard = {tag: now for one in devices for tag in one.tags}
        self._look()

    def applies(self, devices: Sequence[Device]) -> bool:
        return bool(self._speakers)

    def change(self, changes: Changes, now: float, *, is_open: bool) -> None:
        """Stops listening: the line is closed, and perhaps opened again for other devices."""
        self._speakers = ()
        self._heard.clear()
        self.due = math.inf

    def received(self, data: bytes, now: float, time: int) -> None:
        """Takes bytes, and learns what they tell."""
        silence, self._last = now - self._last, now
        pairing = self._pairing
        for heard in self._traffic_reader.feed(data, silence):
            match heard:
                case Asked():
                    pairing.asked(heard, now)
                case Noise():
                    pairing.noise(now)
                    self._count_noise(heard)
                case Told():
                    self._told(heard, now, time)

    def _told(self, told: Told, now: float, time: int) -> None:
        station = self._stations.get(told.station)
        timeout = self._timeout if station is None else station.device.timing.reply_timeout
        asked = self._pairing.told(told, now, timeout)
        if station is None:
            return
        if asked is None:
            if self._pairing.was_extra():
                self._effects.bad(station.last, Reason.GARBLED, time, EXTRA)
                for tag in station.last:
                    self._heard.pop(tag, None)
            return
        station.device.record.count_unsolicited()
        station.device.health.understood()
        self._results.answered(station.device, now, time)
        if asked.read is None or told.is_error:
            return
        read = station.read(asked)
        if station.may_be_repeated(read, told.data):
            self._pairing.not_answered(asked, now)
            return
        if samples := read.samples(told.data, time):
            station.learned(read)
            self._heard |= dict.fromkeys(read.tags, now)
            self._effects.samples(samples)
            self.due = min(self.due, now + read.stale_after)

    def _count_noise(self, noise: Noise) -> None:
        damage = Garbled("bytes that are no whole frame", noise.data, evidence=Evidence.NOISE)
        for station in self._stations.values():
            station.device.record.count_failure(damage)
            if not station.device.health.online:
                station.device.health.not_understood(damage)

    def tick(self, now: float, time: int) -> None:
        """Turns the values bad that were not heard for too long."""
        for station in self._stations.values():
            device = station.device
            old = [tag for tag in device.tags if self._is_old(tag, now)]
            for tag in old:
                del self._heard[tag]
                detail = UNHEARD.format(limit=stale_after(tag))
                self._effects.bad([tag], Reason.OVERDUE, time, detail)
            if old and not any(tag in self._heard for tag in device.tags):
                self._went_silent(device, max(map(stale_after, device.tags)), now)
        self._look()

    def _went_silent(self, device: Device, limit: float, now: float) -> None:
        if device.health.state is State.OFFLINE:
            return
        was_online, why = device.health.online, UNHEARD.format(limit=limit)
        device.health.unclear(Unclear(why), None, now)
        device.health.gave_up(now, 1.0)
        if was_online:
            self._effects.online(device, False)
        self._effects.warning("device offline", device=device.name, why=why)

    def _is_old(self, tag: Tag, now: float) -> bool:
        return tag in self._heard and self._heard[tag] + stale_after(tag) <= now

    def _look(self) -> None:
        self.due = min((at + stale_after(tag) for tag, at in self._heard.items()), default=math.inf)

    def first(self, now: float) -> Idle:
        """Returns no job, whatever is due: this line sends nothing."""
        return Idle(math.inf)
