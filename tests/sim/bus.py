"""One line of the simulation: its traffic, and the excuses for what the gateway reports."""

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from gateway.config import LineConfig
from gateway.engine.device.device import Device
from gateway.engine.device.health import State
from gateway.engine.results.proofs import LONGEST
from gateway.line.line import Line
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.frames import FrameDriver
from gateway.tags import Tag
from tests.sim.episodes import Episode
from tests.sim.foreign import Foreign
from tests.sim.gadgets import Gadget
from tests.sim.hostile import PARTIES
from tests.sim.net import SimNet
from tests.sim.oracle import CHECKS
from tests.sim.requests import (
    ALL,
    Asked,
    answer_in,
    asked,
    is_command,
    is_registration,
    is_write,
    protocol_of,
    shape_of,
    station_in,
)
from tests.sim.stations import Troubled
from tests.sim.story import Story
from tests.sim.wire import SimWire, Speaker

UNTIMELY = (
    "very-late",
    "foreign",
    "junk",
    "noise",
    "noise-after",
    "vanish",
    "hang",
    "stall",
    "flicker",
    *PARTIES,
)
SPOKE_LATELY = 1.0 + 0.7  # seconds: the reply to an unsolicited frame comes within one
SPOKEN = 0.45  # seconds: the longest request and reply of a seed, with an echo and a gap
AFTER_ALL = 0.09  # seconds that stations need after a broadcast


@dataclass(eq=False)
class Bus:
    """Observes a wire. Times by the loop's clock."""

    config: LineConfig
    stations: dict[str, Troubled]
    protocol: str  # of most of its devices
    episodes: Sequence[Episode]  # of this line
    story: Story
    note: Callable[..., None]
    broke: Callable[[str], None]
    now: Callable[[], float]
    began: float
    wire: SimWire | SimNet = field(init=False)
    line: Line = field(init=False)  # built after its port
    sent_at: float = 0.0  # when the gateway sent last
    asked: Device | None = None
    hurt_at: float = -1.0  # when damaged bytes arrived last
    hurt: dict[str, float] = field(default_factory=lambda: {"<": -1.0, ">": -1.0})
    heard: bytes = b""  # since the gateway sent last
    request: bytes = b""  # as it reached the stations
    own: list[bytes] = field(default_factory=list)  # replies of its stations since then
    writes: Counter[int] = field(default_factory=Counter)  # write frames by station number
    # At most so many of these are of transfers that began, and of those that ended.
    carrying: Counter[int] = field(default_factory=Counter)
    carried: Counter[int] = field(default_factory=Counter)
    commands: Counter[int] = field(default_factory=Counter)
    misled: set[str] = field(default_factory=set)  # that accepted a damaged monitor list
    questions: deque[tuple[float, Asked]] = field(default_factory=lambda: deque(maxlen=64))
    open: dict[tuple[int, int], float] = field(default_factory=dict)  # Modbus TCP: since when
    foreign: Foreign = field(init=False)
    speaking: tuple[float, float] = (
        0.0,
        0.0,
    )  # the last unsolicited frame that the gateway could hear
    _to_all_until: float = -1.0
    _registering: Device | None = None
    _proves: bool = False  # the last request proves the read before

    def __post_init__(self) -> None:
        self.foreign = Foreign(lambda data: shape_of(protocol_of(self.protocol, data), data))

    # Traffic

    def sent(self, data: bytes, start: float, end: float) -> None:
        if self._registering is not None:
            self._registered(self._registering)
        # Private: no document tells it.
        self._proves = proves = bool(self.line.engine._in_flight.held)
        if not proves:
            self.sent_at, self.heard, self.request = start, b"", b""
            self.own.clear()
        protocol = protocol_of(self.protocol, data)
        number = station_in(protocol, data)
        self.note("sent", self.config.name, data)
        self.story.counts["frames"] += 1
        self.story.counts[f"frames {protocol}"] += 1
        if start - self._to_all_until < AFTER_ALL:
            self.broke(f"{self.config.name}: spoke {start - self._to_all_until:.3f} s after all")
        named = [d for d in self.line.engine.devices if self.number_of(d) == number]
        if number == ALL.get(protocol):
            self._to_all_until = end
            named = named or [d for d in self.line.engine.devices if d.settings.control]
        if not named:
            self.broke(f"{self.config.name}: spoke to station {number}, which is not served")
            return
        self.asked = named[0]
        health = self.asked.health
        resync = health.needs_resync or not health.online
        self.foreign.sent(data, start, resync=resync, proves=proves)
        poll = not (is_write(protocol, data) or is_command(protocol, data) or health.needs_resync)
        self._check_silence(named[0], start, poll=poll)
        self.writes[number] += is_write(protocol, data)
        self.commands[number] += is_command(protocol, data)
        if is_registration(protocol, data):
            self._registering = self.asked
        if protocol == "modbus-tcp":
            self._questioned(asked(data), named[0])
        elif protocol == "frames":
            self._check_answer(data, named[0])
        begin, until = self.speaking
        heard = begin + 0.001 < start < min(until - 0.001, begin + 1.0)
        if heard and self.hurt["<"] < begin - 0.1:
            self.broke(f"{self.config.name}: spoke into a frame that was coming in")

    @property
    def proof(self) -> float:
        """Seconds that the proof of the last reads may have taken; 0.0: they had none."""
        if not self._proves or self.asked is None:
            return 0.0
        proof = self.asked.timing.reply_timeout + SPOKEN + 4 * self.asked.longest_reply
        return LONGEST + proof

    @property
    def evidence_at(self) -> float:
        """When the gateway saw an extra reply last, as long as it doubts the line."""
        shapes = [device.shapes for device in self.line.engine.devices if device.shapes]
        return max((one.wary_at for one in shapes if one.is_wary), default=-math.inf)

    def _check_silence(self, device: Device, start: float, *, poll: bool) -> None:
        """Checks that the silence before a request other than a poll is not shortened."""
        if not isinstance(self.wire, SimWire):
            return
        silence, safe = self.wire.silence_at(start), device.wire.silence(device.timing)
        if 0.0 <= silence < safe - 1e-6 and self.wire.behind < start - 1.0:
            self.story.counts["shorter silences"] += 1
            if not (poll and device.timing.learn_silence):
                self.broke(f"{device.name}: {silence:.5f} s of silence before what is no poll")

    def number_of(self, device: Device) -> int:
        """Returns the number of the device in a request, as `station_in` finds it."""
        return (
            ord(device.name[-1])
            if isinstance(device.driver, FrameDriver)
            else (device.driver.station)
        )

    def overlapped(self, station: Speaker | None) -> None:
        self.story.counts["overlaps"] += 1
        if isinstance(station, Troubled) and self.unasked(station):
            return  # it cannot be made to wait
        device = next(
            (d for d in self.line.engine.devices if self.stations.get(d.name) is station),
            self.asked,
        )
        if device is None or self.excused(self.now() - self.began - 30.0):
            return
        if any(map(self.keeps_replies, self.stations)):
            return  # a frame that was held may end the request of another station
        if device.state in (State.OFFLINE, State.STARTING):
            return  # the line does not wait for late replies to a probe
        if self._late_in_another_protocol(device):
            return  # such a reply is noise to the driver that waits for another
        self.broke(f"{self.config.name}: spoke while {device.name} did")

    def lost_by_silence(self, request: bytes, station: Speaker | None) -> None:
        number = station_in(protocol_of(self.protocol, request), request)
        addressed = station is None or getattr(station, "number", None) == number
        self.story.counts["lost by silence"] += addressed

    def damaged(self, way: str) -> None:
        self.hurt_at = self.hurt[way] = self.now()
        self.story.counts["damaged"] += 1

    def passed(self, way: str, data: bytes) -> None:
        self.note(way, self.config.name, data)
        if way == "<":
            self.heard += data
            if isinstance(self.wire, SimNet) and len(data) >= 7:
                self.open.pop((data[6], int.from_bytes(data[:2], "big")), None)
        else:
            self.request += data

    def answered(self, request: bytes, reply: bytes) -> None:
        self.own.append(reply)
        self.foreign.answered(request, reply)

    def repeated(self) -> None:
        self.foreign.repeated(self.now())

    def answered_other(self, station: Speaker, request: bytes, reply: bytes) -> None:
        self.story.counts["foreign replies"] += 1
        unknown = isinstance(self.wire, SimWire) and station in self.wire.twins
        self.foreign.answered_other(request, reply, self.now(), unknown=unknown)

    # Unsolicited frames

    @property
    def collides(self) -> bool:
        """Some device of the line sends unsolicited frames and others are polled."""
        drivers = [device.driver for device in self.line.engine.devices]
        speakers = [d for d in drivers if isinstance(d, FrameDriver) and d.sends_unsolicited]
        return bool(speakers) and (len(drivers) > 1 or bool(speakers[0].settings.ask))

    @staticmethod
    def unasked(station: Troubled) -> bool:
        return isinstance(station.inner, Gadget) and station.inner.letter == "z"

    def _check_answer(self, data: bytes, device: Device) -> None:
        number = answer_in(data)
        if number is None:
            return
        self.story.counts["answers"] += 1
        said = self.stations[device.name].inner.said  # type: ignore[attr-defined]
        since = self.now() - SPOKE_LATELY
        held = self.untimely(device.name)  # such a frame tells no time
        if not any((held or at >= since) and value == number for at, _, value in said):
            self._unless_hurt(since, f"{device.name} is answered {number}, which it did not say")

    def _unless_hurt(self, since: float, what: str) -> None:
        if self.hurt_at >= since:
            self.story.counts["blind answers"] += 1
        else:
            self.broke(what)

    # Modbus TCP

    def _questioned(self, question: Asked, device: Device) -> None:
        """Checks that the open requests fit the window and that no number is reused soon."""
        now = self.now()
        since = max(now - device.timing.reply_timeout, self.line.engine.record.since)
        key = question.unit, question.number
        if key in self.open and now - self.open[key] < 30.0:
            self.broke(f"{device.name}: number {question.number} is used again")
        self.open = {k: at for k, at in self.open.items() if now - at < 30.0}
        self.open[key] = now
        waiting = [k for k, at in self.open.items() if k[0] == key[0] and at > since]
        self.story.counts["most open"] = max(self.story.counts["most open"], len(waiting))
        if len(waiting) > device.window:
            self.broke(f"{device.name}: {len(waiting)} questions are open at once")
        self.questions.append((now, question))

    def asked_at(self, tag: Tag) -> float:
        """Returns the start of the transaction that has just read the tag."""
        if self.protocol != "modbus-tcp":
            return self.sent_at
        device = next(d for d in self.line.engine.devices if d.name == tag.device)
        for at, question in reversed(self.questions):  # the latest
            if question.unit == device.driver.station and question.covers(*tag.span):
                return at
        return self.now()

    # Excuses

    def excused(self, since: float) -> bool:
        """A reply may arrive later than any guard, or with the number of another station.

        `since` in seconds from the start, as the episodes have it.
        """
        return any(
            e.kind in UNTIMELY and e.end > since and e.start <= self.now() - self.began
            for e in self.episodes
        )

    def _late_in_another_protocol(self, device: Device) -> bool:
        """On the line, a device of another protocol replies late, or did recently."""
        now = self.now() - self.began
        other = {
            d.name for d in self.line.engine.devices if d.driver.protocol != device.driver.protocol
        }
        return any(
            e.kind == "late" and e.device in ("", *other) and e.start <= now < e.end + 30.0
            for e in self.episodes
        )

    def untimely(self, device: str) -> bool:
        """The device replies, or replied recently, later than the line waits."""
        passed = self.now() - self.began
        return any(
            e.device in ("", device)
            and e.kind in ("very-late", *PARTIES)
            and e.start <= passed < e.end + 10.0
            for e in self.episodes
        )

    def keeps_replies(self, device: str) -> bool:
        """A device server keeps what the device sends, or passes it on one by one."""
        wire = self.wire
        return isinstance(wire, SimWire) and wire.server.keeps_replies(self.stations[device])

    def brought_older(self, since: float) -> bool:
        """A device server brought a station an older request of the gateway since then.

        Its reply fits the open request with the same text, and neither names its request. With a
        protocol the number of bytes or the token of a resync differs; two texts are too few to
        tell how many kept requests are still to come.
        """
        return isinstance(self.wire, SimWire) and self.wire.behind >= since

    def stood_still(self, ago: float) -> float:
        """Returns for how long the loop of the gateway stood still lately, `ago` seconds ago."""
        passed = self.now() - self.began
        return max(
            (
                e.end - e.start
                for e in self.episodes
                if e.kind == "frozen" and e.start <= passed < e.end + ago
            ),
            default=0.0,
        )

    def blind(self, since: float) -> bool:
        """A frame was damaged since then and still has a right check sum, or has none."""
        device = self.asked
        damaged = [
            heard
            for way, heard in (("<", self.heard), (">", self.request))
            if self.hurt[way] >= since
        ]
        if device is not None and device.name in self.misled:
            return True
        if device is not None and not summed(device):
            return bool(damaged)
        protocol = device.driver.protocol if device else self.protocol
        return any(CHECKS[protocol](part) for part in damaged)

    def _registered(self, device: Device) -> None:
        """Notes a device that took a damaged monitor list: its reads are wrong until the next."""
        self._registering = None
        if self.hurt_at >= self.sent_at and self.blind(self.sent_at):
            self.misled.add(device.name)
        else:
            self.misled.discard(device.name)


def summed(device: Device) -> bool:
    """Its frames have a check sum."""
    match device.driver:
        case ComputerLink() as link:
            return link.sum_check
        case FrameDriver() as driver:
            return driver.settings.framing.sum_check
    return True
