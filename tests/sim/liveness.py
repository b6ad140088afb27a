"""One station is broken for ever, and all others live on: `make sim PACE=liveness`.

The seed draws a line of one protocol with 3 to 12 stations, and how one of them is broken. From the
second minute on it never gives a good reply again. All others must keep their sweeps, their write
times and their return times. They share the pair with it: what it sends collides.
"""

import asyncio
import logging
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import structlog

from gateway.engine.device.device import Device
from gateway.engine.forecast import forecast
from gateway.errors import GatewayError, Unclear
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.stations.registry import station_of
from gateway.tags import Quality, WriteRule
from tests.sim.bench import Bench
from tests.sim.manners import refusal
from tests.sim.plant import Plant, clock_word, made_device, make_tag, running
from tests.sim.story import Story
from tests.sim.virtual import now, run_virtual

# It hears nothing; its replies are lost, damaged, cut or late; more follows them; it refuses all.
KINDS = ("deaf", "mute", "garbling", "cutting", "slow", "flooding", "refusing")
KEPT = 0.98  # of the sweeps of the others
# What these send collides with the exchanges of others: polls are repeated, a write is unclear.
COLLIDING, KEPT_COLLIDING = ("slow", "flooding"), 0.95
WRITTEN, OLD = 900, 3000  # the address that is written; ms that a value may be old
WARM = 60.0  # seconds before anything is broken
AWAY = 45.0  # seconds for which another station is away
MARGIN = 0.05  # seconds of a write: its own block may be longer than the mean
BITS = {"Vigor": 10, "ComputerLink": 10, "ModbusRtu": 11, "ModbusAscii": 10}
PROTOCOLS: tuple[Any, ...] = (Vigor, ComputerLink, ModbusRtu, ModbusAscii)


@dataclass
class Part:
    """A station that may be broken, or away."""

    inner: Any
    wire: WireTiming
    chance: random.Random
    broken: str = ""
    away: bool = False
    delay: float = 0.0  # which the simulated line adds to the turnaround

    @property
    def memory(self) -> Any:
        return self.inner.memory

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if self.away or self.broken == "deaf":
            return []
        replies: list[bytes] = self.inner.hear(data, at)
        if not replies or not self.broken:
            return replies
        chance, whole = self.chance, b"".join(replies)
        match self.broken:
            case "garbling":
                spoilt = bytearray(whole)
                spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(7)
                return [bytes(spoilt)]
            case "cutting":
                return [whole[: chance.randrange(1, len(whole))]]
            case "slow":
                self.delay = chance.uniform(0.6, 2.0)
                return [whole]
            case "flooding":
                return [chance.randbytes(chance.randrange(20, 60)), whole, whole]
            case "refusing":
                codes = {"ModbusStation": "04", "VigorStation": "11", "ComputerLinkStation": "06"}
                return [refusal(self.inner, whole, codes[type(self.inner).__name__])]
        return []


class Drawn(NamedTuple):
    plant: Plant
    parts: list[Part]
    broken: Device
    comes: Device  # is away for some time, and comes back
    kind: str


def draw(seed: int, only: Sequence[str]) -> Drawn:
    chance = random.Random(f"liveness {seed}")
    protocol, baud = chance.choice(PROTOCOLS), chance.choice((9600, 19200, 38400, 115200))
    wire = WireTiming(baud, BITS[protocol.__name__])
    area = "holding:" if "Modbus" in protocol.__name__ else "D"
    count, load = chance.randint(3, 12), chance.uniform(0.2, 0.6)
    devices, parts = list[Device](), list[Part]()
    blocks = [
        [chance.choice((1, 4, 8, 20)) for _ in range(chance.randint(1, 3))] for _ in range(count)
    ]
    for every in (1.0, None):  # the first round finds the interval of the wanted load
        if every is None:
            every = max(0.2, round(sum(one.load for one in devices) / load, 2))
            devices.clear()
        for n in range(count):
            driver: AnyDriver = protocol(station=n + 1)
            numbers = [100 * b + i for b, size in enumerate(blocks[n]) for i in range(size)]
            tags = [
                make_tag(f"{area}{i}", driver, device=f"d{n}", type="uint16", every=every)
                for i in numbers
            ]
            rule = WriteRule()
            tags.append(
                make_tag(
                    f"{area}{WRITTEN}",
                    driver,
                    device=f"d{n}",
                    type="uint16",
                    every=60.0,
                    write=rule,
                )
            )
            devices.append(made_device(f"d{n}", driver, wire, driver.timing, tags))
    for one in devices:
        station: Any = station_of(one.driver)
        for tag in one.tags[:-1]:
            n = tag.address.number
            station.memory.animate(tag.address.area, n, lambda at, n=n: clock_word(at, n))
        parts.append(Part(station, wire, random.Random(chance.random())))
    plant = Plant(devices, parts, Bench(seed=seed), wire)  # type: ignore[arg-type]  # all have `hear`
    broken, comes = chance.sample(devices, 2)
    return Drawn(plant, parts, broken, comes, chance.choice(only or KINDS))


@dataclass
class Life:
    """The line beside the broken station, and its judge."""

    drawn: Drawn
    story: Story
    seconds: float

    def __post_init__(self) -> None:
        self.chance, devices = random.Random(f"life {self.story.seed}"), self.drawn.plant.devices
        self.of = dict(zip((one.name for one in devices), self.drawn.parts, strict=True))
        away = (self.drawn.broken, self.drawn.comes)
        self.healthy = [one for one in devices if one not in away]
        self.limits = forecast("line", devices, self.drawn.plant.wire)
        self.collides = self.drawn.kind in COLLIDING
        self.left = 0.0  # seconds that the other one costs when it leaves

    def broke(self, what: str) -> None:
        self.story.broken.append(f"{now():.3f} {what}, beside a {self.drawn.kind} station")

    async def run(self) -> None:
        plant = self.drawn.plant
        async with running(plant):
            await asyncio.sleep(WARM)
            self.of[self.drawn.broken.name].broken = self.drawn.kind
            await asyncio.sleep(WARM)
            since = now()
            tasks = [asyncio.create_task(self.write()), asyncio.create_task(self.come_and_go())]
            await asyncio.sleep(self.seconds)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self.judge(since)

    async def come_and_go(self) -> None:
        one = self.drawn.comes
        within = self.limits.seen_at_worst + 2 * one.tags[0].every + 1.0
        while True:
            await asyncio.sleep(self.chance.uniform(5.0, 60.0))
            self.of[one.name].away = True
            self.left += (one.timing.retries + 1) * one.longest_reply
            await asyncio.sleep(AWAY)
            self.of[one.name].away, returned = False, now()
            while not self.drawn.plant.reads(one, returned):
                await asyncio.sleep(0.05)
            self.story.counts["returns"] += 1
            if (took := now() - returned) > within:
                self.broke(f"{one.name} was not read for {took:.1f} s, promised {within:.1f}")

    async def write(self) -> None:
        most = self.limits.worst_write_silent + MARGIN
        while self.healthy:
            await asyncio.sleep(self.chance.uniform(0.5, 7.0))
            one, value, asked = self.chance.choice(self.healthy), self.chance.randrange(1000), now()
            most_now = most + self.collides * one.longest_reply
            self.story.counts["writes"] += 1
            try:
                await self.drawn.plant.line.write(one, one.tags[-1], one.tags[-1].encode(value))
            except GatewayError as error:
                if not (self.collides and isinstance(error, Unclear)):
                    self.broke(f"write of {value} to {one.name}: {error!r}")
                self.story.counts["unclear writes"] += 1
                continue
            if (took := now() - asked) > most_now:
                self.broke(f"write of {value} to {one.name} took {took:.3f}, not {most_now:.3f} s")

    def judge(self, since: float) -> None:
        plant, seconds = self.drawn.plant, now() - since - self.left
        for one in self.healthy:
            reads = len(plant.reads(one, since))
            self.story.counts["sweeps"] += reads
            kept = reads * one.tags[0].every / seconds
            if kept < (KEPT_COLLIDING if self.collides else KEPT):
                self.broke(f"{one.name} was not read for {1 - kept:.1%} of the time")
        for at, sample in plant.reported:
            number = sample.tag.address.number
            if sample.quality is Quality.GOOD and number != WRITTEN:
                self.story.counts["good samples"] += 1
                value = sample.value
                if not isinstance(value, int) or (clock_word(at, number) - value) % 65536 > OLD:
                    self.broke(f"{sample.tag.key} = {value}, which was not in the PLC")
        self.story.counts["frames"] = len(plant.bench.sent)


def run(
    seed: int,
    hours: float,
    pace: str = "liveness",
    only: Sequence[str] = (),
    *,
    traced: bool = False,
) -> Story:
    """Runs one seed. `only`: how a station may be broken; empty: in any way."""
    before = structlog.get_config()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    story = Story(seed, hours, pace, tuple(only))
    drawn = draw(seed, only)
    try:
        run_virtual(Life(drawn, story, hours * 3600).run())
    finally:
        structlog.configure(**before)
    return story
