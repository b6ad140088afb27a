"""A whole gateway on virtual time among faults, and everything it says held against the truth.

    broken = run(seed, hours=4).broken

One seed gives one run, byte for byte: `run(seed).trace` is the hash of all that happened.
"""

import asyncio
import hashlib
import logging
import random
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import structlog

from gateway.app import Gateway
from gateway.config import DeviceConfig, LineConfig, load
from gateway.device import Device, Standing
from gateway.errors import BadValue, Busy, GatewayError, LineDown, Offline, Refused
from gateway.line import Line
from gateway.stations.computer_link import ComputerLinkStation
from gateway.tags import Quality, Reason, Sample, Tag, Written
from gateway.transport import Ear
from gateway.values import Kind, Value
from tests.sim.draw import CALM, Drawn, Episode, draw
from tests.sim.oracle import CHECKS
from tests.sim.stations import Troubled, station_of
from tests.sim.virtual import run_virtual
from tests.sim.wire import Format, Noise, SimWire, Speaker

SECOND = 1_000_000_000
SPOKEN = 0.35  # seconds: the longest frames of a seed, there and back
LONGEST_PAUSE = 66.0  # between two probes of a silent device
UNTIMELY = ("very-late", "foreign", "junk", "noise", "noise-after", "vanish", "hang", "flicker")
DISTURBING = ("late", *UNTIMELY)  # late answers to probes are not waited for, and may hit others
MOST_TROUBLES = 20  # noted in one run


@dataclass
class Story:
    """What came of one seed."""

    seed: int
    hours: float
    pace: str = "busy"
    broken: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    trace: str = ""

    def replay(self) -> str:
        return f"make sim SEEDS={self.seed} HOURS={self.hours:g} PACE={self.pace}"


@dataclass(eq=False)
class Bus:
    """One line as the judge sees it."""

    config: LineConfig
    wire: SimWire
    stations: dict[str, Troubled]
    line: Line
    protocol: str
    world: "World"
    sent_at: float = 0.0  # when the gateway spoke last
    asked: Device | None = None
    hurt_at: float = -1.0  # when something damaged arrived last
    hurt: dict[str, float] = field(default_factory=lambda: {"<": -1.0, ">": -1.0})
    heard: bytes = b""  # since the gateway spoke last
    request: bytes = b""  # as it reached the stations
    writes: Counter[int] = field(default_factory=Counter)  # write frames by station number

    # The watch of the wire

    def sent(self, data: bytes, start: float, end: float) -> None:
        self.sent_at, self.heard, self.request = start, b"", b""
        number = station_in(self.protocol_of(data), data)
        names = [d for d in self.line.devices if d.driver.station == number]
        self.world.note("sent", self.line.name, data)
        self.world.story.counts["frames"] += 1
        if not names:
            self.world.broke(f"{self.line.name}: spoke to station {number}, which is not served")
            return
        self.asked = names[0]
        if is_write(self.protocol_of(data), data):
            self.writes[number] += 1

    def protocol_of(self, data: bytes) -> str:
        if self.protocol == "vigor" and data[:1] == b"\x05" and data[3:5] == b"FF":
            return "computer-link"
        return self.protocol

    def overlapped(self, station: Speaker | None) -> None:
        world = self.world
        world.story.counts["overlaps"] += 1
        device = next(
            (d for d in self.line.devices if self.stations[d.name] is station), self.asked
        )
        if device is None or self._excused(world.passed - 30.0):
            return
        if device.standing in (Standing.SILENT, Standing.STARTING):
            return  # nobody waits for late answers to a probe: that is the rule
        world.broke(f"{self.line.name}: spoke while {device.name} did")

    def damaged(self, way: str) -> None:
        self.hurt_at = self.hurt[way] = self.world.now
        self.world.story.counts["damaged"] += 1

    def passed(self, way: str, data: bytes) -> None:
        self.world.note(way, self.line.name, data)
        if way == "<":
            self.heard += data
        else:
            self.request += data

    # What excuses it

    def _excused(self, since: float) -> bool:
        """Whether an answer may come at any time: later than any guard, or in another's name."""
        return any(
            e.line == self.line.name
            and e.kind in UNTIMELY
            and e.end > since
            and e.start <= self.world.passed
            for e in self.world.drawn.episodes
        )

    def blind(self, since: float) -> bool:
        """Something was damaged since then, and its own check sum agrees."""
        protocol = self.asked.driver.protocol if self.asked else self.protocol
        damaged = [
            heard
            for way, heard in (("<", self.heard), (">", self.request))
            if self.hurt[way] >= since
        ]
        return any(CHECKS[protocol](part) for part in damaged)


@dataclass(eq=False)
class World:
    """Gateway, stations, faults and judge."""

    drawn: Drawn
    story: Story
    seconds: float
    buses: dict[str, Bus] = field(default_factory=dict)
    stations: dict[str, Troubled] = field(default_factory=dict)  # by device
    refused: set[Tag] = field(default_factory=set)
    read_at: dict[Tag, float] = field(default_factory=dict)
    alive: dict[str, bool] = field(default_factory=dict)
    wall_offset: float = 0.0

    def __post_init__(self) -> None:
        self._trace = hashlib.sha256()
        self._loop = asyncio.get_running_loop()
        self.began = self._loop.time()
        with tempfile.TemporaryDirectory() as folder:
            self.config = load(self.drawn.write(Path(folder)))
        self.gateway = Gateway(self.config, self.wall, self._opener)
        self.gateway.publish = self._published
        self.gateway.show_alive = self._shown_alive
        self.known = {tag for device in self.config.devices for tag in device.tags}
        self.devices = {d.name: d for line in self.gateway.lines for d in line.devices}
        for line, settings in zip(self.gateway.lines, self.config.lines, strict=True):
            self.buses[line.name].line = line
            self.buses[line.name].config = settings

    @property
    def now(self) -> float:
        return self._loop.time()

    @property
    def passed(self) -> float:
        return self._loop.time() - self.began

    def wall(self) -> int:
        return 1_700_000_000 * SECOND + int((self._loop.time() + self.wall_offset) * SECOND)

    def note(self, *what: object) -> None:
        self._trace.update(repr((self._loop.time(), *what)).encode())

    def broke(self, what: str) -> None:
        if len(self.story.broken) < MOST_TROUBLES:
            self.story.broken.append(f"{self.passed:.3f} s: {what}")

    # Building

    def _opener(self, config: LineConfig) -> Callable[[Ear], Any]:
        chance = random.Random(f"wire {self.story.seed} {config.name}")
        stations = [self._station(device, config, chance) for device in config.devices]
        for station in stations:
            station.others = [other for other in stations if other is not station]
        data_bits, parity, stop = config.serial.format
        shape = Format(int(data_bits), parity != "N", int(stop), self.drawn.zeros[config.name])
        wire = SimWire(
            config.wire,
            shape,
            stations,
            chance,
            None,  # type: ignore[arg-type]  # its bus, one line on
            config.echo,
            self.drawn.chunks[config.name],
        )
        wire.watch = self.buses[config.name] = Bus(
            config,
            wire,
            {d.name: s for d, s in zip(config.devices, stations, strict=True)},
            None,  # type: ignore[arg-type]  # the line is built after its port
            config.devices[0].driver.protocol,
            self,
        )
        by_number = {station.number: [station] for station in stations}
        bus = self.buses[config.name]
        if bus.protocol != "vigor":
            wire.addressed = lambda data: by_number[station_in(bus.protocol, data)]
        return wire.open

    def _station(self, device: DeviceConfig, line: LineConfig, chance: random.Random) -> Troubled:
        words = next(tag for tag in device.tags if tag.name == "scaled").span.area
        missing = {(words, n) for n in self.drawn.missing.get(device.name, ())}
        inner = station_of(device.driver, device.tags, missing)
        self.refused |= {
            tag
            for tag in device.tags
            for n in range(tag.span.start, tag.span.start + tag.span.size)
            if (tag.span.area, n) in missing
        }
        station = Troubled(
            device.driver.station, inner, random.Random(chance.random()), line.wire.character
        )
        station.turnaround = chance.choice((0.001, 0.005, 0.02, 0.05))
        self.stations[device.name] = station
        return station

    # What comes out of the gateway

    def _published(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self.note("sample", sample.tag.key, sample.value, sample.quality.value, sample.time)
            if sample.tag not in self.known:
                self.broke(f"{sample.tag.key} is not configured, but published")
            if sample.reason is Reason.LINE_DOWN and "internal error" in sample.detail:
                self.broke(f"{sample.tag.key}: {sample.detail}")
            if sample.quality is Quality.GOOD:
                self._judge(sample)
            else:
                self.story.counts["bad samples"] += 1

    def _judge(self, sample: Sample) -> None:
        tag = sample.tag
        bus = self.buses[self._line_of(tag)]
        self.story.counts["good samples"] += 1
        self.read_at[tag] = self.now
        value = sample.value
        assert value is not None
        station = self.stations[tag.device]
        if tag not in self.refused and station.was(tag, value, bus.sent_at, self.now):
            return
        if bus.blind(bus.sent_at):
            self.story.counts["blind reads"] += 1
        else:
            self.broke(
                f"{tag.key} is told as good {value!r}, which was not in the PLC since "
                f"{bus.sent_at - self.began:.3f}: heard {bus.heard!r}"
            )

    def _line_of(self, tag: Tag) -> str:
        return self.gateway._places[tag.device][0].name

    def _shown_alive(self, device: str, alive: bool) -> None:
        self.note("alive", device, alive)
        self.alive[device] = alive
        if device not in self.devices:
            self.broke(f"{device} is not configured, but shown")

    # What others do

    async def write_now_and_then(self, device: Device) -> None:
        chance = random.Random(f"writer {self.story.seed} {device.name}")
        tags = [tag for tag in device.tags if tag.write is not None]
        number = chance.randrange(1000)
        pause = chance.choice((2.0, 10.0, 30.0, 120.0)) * (10 if self.story.pace == "lean" else 1)
        while True:
            await asyncio.sleep(chance.expovariate(1 / pause))
            tag = chance.choice(tags)
            number += 1
            if tag.layout.type.kind is Kind.BOOL:
                value: Value = chance.random() < 0.5
            else:
                bits = 32 if tag.span.size == 2 else 16
                value = (number * 40_503) % (1 << bits)
            await self._write(device, tag, value)

    async def _write(self, device: Device, tag: Tag, value: Value) -> None:
        bus, station = self.buses[self._line_of(tag)], self.stations[device.name]
        number = device.driver.station
        frames, since = bus.writes[number], self.now
        known = len(station.written.get((tag.span.area, tag.span.start), ()))
        held = tag.decode(station.holds(tag))
        outcome: Written | GatewayError
        try:
            outcome = await self.gateway.write(tag, value)
        except GatewayError as error:
            outcome = error
        sent = bus.writes[number] - frames
        self.note("outcome", tag.key, value, type(outcome).__name__, sent)
        self.story.counts[f"write {type(outcome).__name__}"] += 1
        holds = tag.decode(station.holds(tag)) == value
        obeyed = len(station.written.get((tag.span.area, tag.span.start), ())) > known
        most = 2 if tag.write is not None and tag.write.repeat else 1
        if sent > most:
            self.broke(f"{tag.key}: a write was sent {sent} times")
        match outcome:
            case Written():
                true = holds and (obeyed or held == value)
            case Refused() | BadValue():
                true = not obeyed or held == value
            case Busy() | Offline() | LineDown():
                true = sent == 0 and not obeyed
            case _:
                return
        if true:
            return
        if bus.hurt_at >= since:
            self.story.counts["blind writes"] += 1
        else:
            self.broke(
                f"{tag.key}: write of {value!r} ended {outcome!r}, sent {sent} times, "
                f"obeyed {obeyed}, holds {holds}"
            )
        await asyncio.sleep(0)

    async def ask_now_and_then(self, device: Device) -> None:
        """Somebody asks for fresh values."""
        chance = random.Random(f"reader {self.story.seed} {device.name}")
        pause = chance.choice((5.0, 30.0, 300.0)) * (10 if self.story.pace == "lean" else 1)
        while True:
            await asyncio.sleep(chance.expovariate(1 / pause))
            tag = chance.choice(device.tags)
            most, asked = chance.choice((0.0, 0.5, 5.0, 60.0)), self.now
            try:
                sample = await self.gateway.fresh(tag, most)
            except Busy:
                self.story.counts["fresh Busy"] += 1
                continue
            self.note("fresh", tag.key, sample.value)
            if sample.quality is not Quality.GOOD or sample.value is None:
                continue
            self.story.counts["fresh"] += 1
            station, bus = self.stations[device.name], self.buses[self._line_of(tag)]
            if not station.was(tag, sample.value, asked - most - 1.5, self.now) and (
                bus.hurt_at < asked - most - 1.5
            ):
                self.broke(f"{tag.key}: {sample.value!r} is not fresh within {most} s")

    # What goes wrong

    async def suffer(self) -> None:
        moments: list[tuple[float, int, str, Any]] = []
        for episode in self.drawn.episodes:
            moments.append((episode.start, len(moments), "begin", episode))
            moments.append((episode.end, len(moments), "end", episode))
        moments += [(at, -1, "jump", by) for at, by in self.drawn.jumps]
        for at, _, what, which in sorted(moments, key=lambda m: m[:3]):
            await asyncio.sleep(max(0.0, self.began + at - self.now))
            self.note(what, str(which))
            match what:
                case "jump":
                    self.wall_offset += which
                case "begin":
                    self._begin(which)
                case "end":
                    self._end(which)

    def _begin(self, episode: Episode) -> None:
        self.story.counts[f"episode {episode.kind}"] += 1
        wire = self.buses[episode.line].wire
        strength = episode.strength
        match episode.kind:
            case "noise":
                wire.noise = Noise(before=strength)
            case "noise-after":
                wire.noise = Noise(after=strength)
            case "vanish" | "flicker":
                wire.vanish("unplugged")
            case "hang":
                wire.hanging = True
            case kind:
                self._trouble(self.stations[episode.device], episode, kind)
        if episode.silent and not self._mixed(episode.start, episode):
            self._expect_bad(episode)

    def _trouble(self, station: Troubled, episode: Episode, kind: str) -> None:
        device = self.devices.get(episode.device)
        timeout = device.timing.reply_timeout if device else 0.5
        guard = device.late_guard if device else 0.5
        strength = episode.strength
        match kind:
            case "deaf":
                station.deaf = True
            case "reboot":
                station.deaf = True
                if isinstance(station.inner, ComputerLinkStation):
                    station.inner.forget_monitor()
            case "mute":
                station.mute = True
            case "lose" | "cut" | "foreign" | "junk":
                setattr(station, kind, strength)
            case "slow":
                station.late = lambda c: c.uniform(0.0, 0.9) * (timeout - station.turnaround)
            case "late":
                longest = max(0.0, timeout + 0.8 * guard - station.turnaround)
                station.late = lambda c: c.uniform(0.0, longest) if c.random() < strength else 0.0
            case "very-late":
                station.late = lambda c: c.uniform(0.0, 3.0) if c.random() < strength else 0.0

    def _end(self, episode: Episode) -> None:
        wire = self.buses[episode.line].wire
        if episode.device:
            self.stations[episode.device].well()
        wire_kinds = {"noise": Noise(), "noise-after": Noise()}
        if episode.kind in wire_kinds:
            wire.noise = wire_kinds[episode.kind]
        elif episode.kind in ("vanish", "flicker"):
            wire.come_back()
        elif episode.kind == "hang":
            wire.hanging = False
        self._expect_good(episode)

    # What must follow

    def _mixed(self, since: float, episode: Episode) -> bool:
        """Whether the line itself has other trouble at that time."""
        return any(
            other is not episode
            and other.line == episode.line
            and not other.device
            and other.start < episode.end
            and other.end + 100 > since
            for other in self.drawn.episodes
        )

    def _times(self, line: Line) -> tuple[float, float]:
        """The longest that one failed conversation takes, and the line's load."""
        longest = max(d.timing.reply_timeout + d.late_guard for d in line.devices) + SPOKEN
        return longest, max(1.0, sum(d.load for d in line.devices))

    def _expect_bad(self, episode: Episode) -> None:
        line = self.buses[episode.line].line
        if not line.devices:
            return
        longest, load = self._times(line)
        devices = [d for d in line.devices if episode.device in ("", d.name)]
        for device in devices:
            for tag in device.tags:
                limit = 2 * load * tag.every + 2 * (len(line.devices) + 2) * longest + 1.0
                if episode.start + limit < episode.end:
                    self._loop.call_later(limit, self._must_be_bad, tag, episode)

    def _must_be_bad(self, tag: Tag, episode: Episode) -> None:
        self.story.counts["silence checks"] += 1
        if self.gateway.mirror[tag].quality is Quality.GOOD:
            self.broke(
                f"{tag.key} is still good, {self.passed - episode.start:.1f} s after "
                f"{episode.device or episode.line} became silent ({episode.kind})"
            )

    def _expect_good(self, episode: Episode) -> None:
        line = self.buses[episode.line].line
        if not line.devices:
            return
        longest, load = self._times(line)
        devices = [d for d in line.devices if episode.device in ("", d.name)]
        silent = len(line.devices)
        for device in devices:
            for tag in device.tags:
                limit = LONGEST_PAUSE + 20 * longest * silent + 2 * load * tag.every + 5.0
                until = episode.end + limit
                troubled = any(
                    other is not episode
                    and other.line == episode.line
                    and (other.device in ("", device.name) or other.kind in DISTURBING)
                    and other.start < until
                    and other.end > episode.end - LONGEST_PAUSE
                    for other in self.drawn.episodes
                )
                if not troubled and until < self.seconds:
                    self._loop.call_later(limit, self._must_be_good, tag, limit, episode)

    def _must_be_good(self, tag: Tag, limit: float, episode: Episode) -> None:
        self.story.counts["recovery checks"] += 1
        sample = self.gateway.mirror[tag]
        if (sample.quality is Quality.GOOD) is (tag in self.refused):
            self.broke(
                f"{tag.key} is {sample.quality.value} ({sample.reason}: {sample.detail}) "
                f"{limit:.0f} s after {episode.kind} of {episode.device or episode.line} ended"
            )

    async def look_around(self) -> None:
        """Now and then: nothing piles up, and who is well is served."""
        while True:
            await asyncio.sleep(60.0)
            for line in self.gateway.lines:
                schedule = line._schedule
                polls = sum(len(schedule.polls(device)) for device in line.devices)
                kept = len(schedule._waiting) + len(schedule._ready) + len(schedule._urgent)
                if kept > 4 * polls + 50:
                    self.broke(f"{line.name}: {kept} places in the queues for {polls} polls")
                if len(schedule.orders) > len(line.devices):
                    self.broke(f"{line.name}: {len(schedule.orders)} writes wait")
            waiting = sum(map(len, self.gateway._waiting.values()))
            if waiting > 2 * len(self.devices):
                self.broke(f"{waiting} who asked for fresh values are still remembered")
            timers = len(self._loop._scheduled)  # type: ignore[attr-defined]
            most = 400 + 8 * len(self.known) + 4 * len(self.drawn.episodes)
            if timers > most:
                self.broke(f"{timers} timers are waiting")
            self.story.counts["most timers"] = max(self.story.counts["most timers"], timers)
            self._look_at_shares()

    def _look_at_shares(self) -> None:
        """A device that has been well for two minutes, on a line that was, is served."""
        for bus in self.buses.values():
            if not bus.line.devices:
                continue
            longest, load = self._times(bus.line)
            for device in bus.line.devices:
                for tag in device.tags:
                    patience = 4 * load * tag.every + 6 * longest * len(bus.line.devices)
                    since = max(self.read_at.get(tag, 0.0), 0.0)
                    if tag in self.refused or tag.publish.value != "always":
                        continue
                    if self.now - since <= patience:
                        continue
                    begin = self.passed - patience - LONGEST_PAUSE - 25 * longest - 60
                    if begin < 0 or self._unwell(bus.line.name, device.name, begin):
                        continue
                    self.story.counts["starved"] += 1
                    self.broke(
                        f"{tag.key} was not read for {self.now - since:.1f} s, "
                        f"every {tag.every:g} s is asked for, load {load:.2f}"
                    )

    def _unwell(self, line: str, device: str, since: float) -> bool:
        return any(
            e.line == line
            and (e.device in ("", device) or e.kind in DISTURBING)
            and e.end > since
            and e.start < self.passed
            for e in self.drawn.episodes
        )

    # The run

    async def live(self) -> None:
        for line in self.gateway.lines:
            for device in line.devices:
                station = self.stations[device.name]
                for tag in device.tags:
                    if tag.write is not None:
                        start = [0] * tag.span.size
                        station.inner.memory.write(tag.span.area, tag.span.start, start)
        tasks = [asyncio.create_task(line.run(), name=line.name) for line in self.gateway.lines]
        served = len(tasks)
        for device in self.devices.values():
            tasks.append(asyncio.create_task(self.write_now_and_then(device)))
            tasks.append(asyncio.create_task(self.ask_now_and_then(device)))
        tasks += [asyncio.create_task(self.suffer()), asyncio.create_task(self.look_around())]
        done, _ = await asyncio.wait(
            tasks[:served] + tasks[served:-2] + tasks[-1:],
            timeout=self.seconds,
            return_when=asyncio.FIRST_COMPLETED,
        )
        for task in done:
            self.broke(f"{task.get_name()} ended by itself: {task.exception()!r}")
        self._judge_the_end()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for bus in self.buses.values():
            if bus.wire.opened != bus.wire.closed:
                self.broke(
                    f"{bus.line.name}: opened {bus.wire.opened} times, closed {bus.wire.closed}"
                )
        self.story.trace = self._trace.hexdigest()

    def _judge_the_end(self) -> None:
        """Nothing has gone wrong for a while."""
        if self.seconds < 2 * CALM:
            return
        for device in self.devices.values():
            if device.standing is not Standing.UP or not self.alive.get(device.name):
                self.broke(f"{device.name} is {device.standing.value} at the end: {device.trouble}")
            for tag in device.tags:
                good = self.gateway.mirror[tag].quality is Quality.GOOD
                if good is (tag in self.refused):
                    self.broke(f"{tag.key} at the end: {self.gateway.mirror[tag]}")


def is_write(protocol: str, data: bytes) -> bool:
    match protocol:
        case "vigor":
            return data[3:5] in (b"61", b"70", b"71")
        case "computer-link":
            return data[5:7] in (b"BW", b"WW", b"BT", b"WT")
        case "modbus-rtu":
            return data[1] in (5, 6, 15, 16)
    return data[3:5] in (b"05", b"06", b"0F", b"10")


def station_in(protocol: str, data: bytes) -> int:
    return data[0] if protocol == "modbus-rtu" else int(data[1:3], 16)


def run(seed: int, hours: float, pace: str = "busy") -> Story:
    """One seed, from the drawing of its plant to the last look at it."""
    story = Story(seed, hours, pace)
    seconds = hours * 3600

    async def whole() -> None:
        await World(draw(seed, seconds, pace), story, seconds).live()

    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    try:
        run_virtual(whole())
    except Exception as error:  # noqa: BLE001 - whatever it was, the seed is worth knowing
        story.broken.append(f"the run itself ended: {error!r}")
    finally:
        structlog.configure(**before)
    return story
