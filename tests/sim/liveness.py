"""One station is broken for ever, and all others live on: `make sim PACE=liveness`.

The seed draws a line of one protocol with 3 to 12 stations, and how one of them is broken from the
second minute on. All others must keep their sweeps, their write times and their return times. They
share the pair with it: what it sends collides. Two kinds take a part of the wire that no master
can give back; the judge knows how much, and asks for the rest:

* A flooding station replies, with junk before and a second reply behind. It has the wire until
  another one is asked. Each read on the line needs a proof, which takes about as long as `check`
  prints. Where the station itself has little of the wire, what is lost is due to these proofs.
* A bursting station speaks by itself, and destroys one exchange each time.
"""

import asyncio
import logging
import random
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import structlog

from gateway.engine.device.device import Device
from gateway.engine.forecast import forecast
from gateway.engine.results.giving_way import GAP
from gateway.engine.schedule.probes import ONE_OFFLINE, seen_within
from gateway.errors import GatewayError, Unclear
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.vigor import Vigor
from gateway.stations.registry import station_of
from gateway.tags import Quality, WriteRule
from tests.sim.bench import TURNAROUND, Bench
from tests.sim.manners import refusal
from tests.sim.plant import Plant, clock_word, made_device, make_tag, running
from tests.sim.story import Story
from tests.sim.virtual import now, run_virtual

KINDS = (
    "deaf",  # no request reaches it
    "mute",  # it carries requests out, and no reply arrives
    "one-eared",  # it hears only other stations
    "garbling",  # its replies are damaged,
    "cutting",  # or end early,
    "slow",  # or come at the end of the time-out,
    "late",  # or after it
    "flooding",  # junk is before its reply, and a second reply behind it
    "bursting",  # it speaks while others reply
    "refusing",
)
# Of the sweeps of the others, or of those that the wire could carry. What proofs take is estimated.
KEPT, KEPT_DOUBTFUL = 0.98, 0.9
LITTLE, KEPT_BY_PROOFS = 0.03, 0.5  # of the wire that the station has; of that estimate
REST = (3.0, 20.0)  # seconds between two bursts
WRITTEN, OLD = 900, 3000  # the address that is written; ms that a value may be old
WARM = 60.0  # seconds before anything is broken
AWAY = 45.0  # seconds for which another station is away
MARGIN = 0.05  # seconds of a write: its own block may be longer than the mean
BITS = {"Vigor": 10, "ComputerLink": 10, "ModbusRtu": 11, "ModbusAscii": 10, "ModbusTcp": 10}
PROTOCOLS: tuple[Any, ...] = (Vigor, ComputerLink, ModbusRtu, ModbusAscii, ModbusTcp)
# There nothing collides, no byte is damaged, and a second reply has the number of the first.
NOT_ON_NETWORKS = ("bursting", "flooding", "garbling")


@dataclass
class Part:
    """A station that may be broken, or away."""

    inner: Any
    device: Device
    chance: random.Random
    broken: str = ""
    away: bool = False
    delay: float = 0.0  # which the simulated line adds to the turnaround
    took: float = 0.0  # seconds of the wire that nobody can give back
    rests_until: float = 0.0
    speaks_until: float = 0.0
    asked: float | None = None  # when it was asked last, if no other one was since
    collides: list[float] = field(default_factory=list)  # when it speaks unasked, or late
    listener: "Part | None" = None  # it hears what this station says

    @property
    def memory(self) -> Any:
        return self.inner.memory

    def hear(self, data: bytes, at: float) -> list[bytes]:
        if self.broken == "flooding" and self.asked is not None:
            self.took, self.asked = self.took + at - self.asked, None
            if at - len(data) * self.device.wire.character < self.speaks_until:
                self.took += self.device.longest_reply  # this request is destroyed
        if self.away or self.broken in ("deaf", "one-eared"):
            return []
        if self.broken == "bursting":
            return self._burst(at)
        replies: list[bytes] = self.inner.hear(data, at)
        if replies and self.listener is not None and self.listener.broken == "one-eared":
            replies += self.listener.inner.hear(b"".join(replies), at)
        return self._spoil(b"".join(replies), at) if replies and self.broken else replies

    def _spoil(self, whole: bytes, at: float) -> list[bytes]:
        """Returns what it sends in place of its reply."""
        chance, timeout = self.chance, self.device.timing.reply_timeout
        match self.broken:
            case "garbling":
                spoilt = bytearray(whole)
                spoilt[chance.randrange(len(spoilt))] ^= 1 << chance.randrange(7)
                return [bytes(spoilt)]
            case "cutting":
                return [whole[: chance.randrange(1, len(whole))]]
            case "slow":
                self.delay = chance.uniform(0.5, 0.9) * timeout
                return [whole]
            case "late":
                self.delay = chance.uniform(1.1, 4.0) * timeout
                self.collides.append(at + self.delay)
                return [whole]
            case "flooding":
                self.asked = at
                self.collides.append(at)
                said = [chance.randbytes(chance.randrange(20, 60)), whole, whole]
                length = sum(map(len, said)) * self.device.wire.character
                self.speaks_until = at + TURNAROUND + length
                return said
            case "refusing":
                codes = {"ModbusStation": "04", "VigorStation": "11", "ComputerLinkStation": "06"}
                return [refusal(self.inner, whole, codes[type(self.inner).__name__])]
        return []

    def _burst(self, at: float) -> list[bytes]:
        """Speaks while the station that was asked replies: the master waits in vain."""
        if at < self.rests_until:
            return []
        self.rests_until = at + self.chance.uniform(*REST)
        self.collides.append(at)
        junk = self.chance.randbytes(self.chance.randrange(20, 200))
        self.took += max(len(junk) * self.device.wire.character, self.device.longest_reply)
        return [junk]


class Drawn(NamedTuple):
    plant: Plant
    parts: list[Part]
    broken: Device
    comes: Device  # is away for some time, and comes back
    kind: str


def draw(seed: int, only: Sequence[str]) -> Drawn:
    chance = random.Random(f"liveness {seed}")
    kind = chance.choice(only or KINDS)
    usable = PROTOCOLS[:-1] if kind in NOT_ON_NETWORKS else PROTOCOLS
    protocol, baud = chance.choice(usable), chance.choice((9600, 19200, 38400, 115200))
    if protocol is ModbusTcp:
        baud = NETWORK_BAUD
    wire = WireTiming(baud, BITS[protocol.__name__])
    area = "holding:" if "Modbus" in protocol.__name__ else "D"
    count, load = chance.randint(3, 12), chance.uniform(0.2, 0.6)
    devices, parts = list[Device](), list[Part]()
    blocks = [
        [chance.choice((1, 4, 8, 20)) for _ in range(chance.randint(1, 3))] for _ in range(count)
    ]
    least = 1.0 if protocol is ModbusTcp else 0.2  # less is only more work
    for every in (1.0, None):  # the first round finds the interval of the wanted load
        if every is None:
            every = max(least, round(sum(one.load for one in devices) / load, 2))
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
            timing = replace(driver.timing, turnaround=max(driver.timing.turnaround, TURNAROUND))
            devices.append(made_device(f"d{n}", driver, wire, timing, tags))
    for one in devices:
        station: Any = station_of(one.driver)
        for tag in one.tags[:-1]:
            n = tag.address.number
            station.memory.animate(tag.address.area, n, lambda at, n=n: clock_word(at, n))
        parts.append(Part(station, one, random.Random(chance.random())))
    plant = Plant(devices, parts, Bench(seed=seed), wire)  # type: ignore[arg-type]  # all have `hear`
    broken, comes = chance.sample(devices, 2)
    for part in parts:
        part.listener = parts[devices.index(broken)] if part.device is not broken else None
    return Drawn(plant, parts, broken, comes, kind)


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
        self.bad = self.of[self.drawn.broken.name]
        self.left = 0.0  # seconds that the other one costs when it leaves

    def broke(self, what: str) -> None:
        self.story.broken.append(f"{now():.3f} {what}, beside a {self.drawn.kind} station")

    async def run(self) -> None:
        plant = self.drawn.plant
        async with running(plant):
            await asyncio.sleep(WARM)
            self.bad.broken = self.drawn.kind
            await asyncio.sleep(WARM)
            since, self.bad.took = now(), 0.0
            tasks = [asyncio.create_task(self.write()), asyncio.create_task(self.come_and_go())]
            await asyncio.sleep(self.seconds)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self.judge(since)

    async def come_and_go(self) -> None:
        one = self.drawn.comes
        devices, limits = self.drawn.plant.devices, self.limits
        seen = limits.seen_at_worst
        if self.drawn.kind in ("slow", "flooding"):  # then the wire may be full
            longest = max(device.longest_poll for device in devices)
            _, seen = seen_within(devices, 1.0, limits.requests, longest)
        within = seen + 2 * one.tags[0].every + 1.0
        while True:
            await asyncio.sleep(self.chance.uniform(5.0, 60.0))
            self.of[one.name].away = True
            self.left += (one.timing.retries + 1) * one.longest_reply + AWAY * ONE_OFFLINE
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
            self.story.counts["writes"] += 1
            try:
                await self.drawn.plant.line.write(one, one.tags[-1], one.tags[-1].encode(value))
            except GatewayError as error:
                if not (isinstance(error, Unclear) and self.met(asked)):
                    self.broke(f"write of {value} to {one.name}: {error!r}")
                self.story.counts["unclear writes"] += 1
                continue
            # What is in flight may be a read that waits in vain, or for its proof.
            more = one.longest_reply if self.met(asked) or self.drawn.kind == "flooding" else 0.0
            more += GAP if self.drawn.kind == "flooding" else 0.0  # then the wire must be quiet
            if (took := now() - asked) > most + more:
                self.broke(
                    f"write of {value} to {one.name} took {took:.3f}, not {most + more:.3f} s"
                )

    def met(self, asked: float) -> bool:
        """Returns True if the broken station has spoken out of turn since then."""
        return any(asked - 1.0 <= at <= now() for at in self.bad.collides[-9:])

    def could(self, seconds: float) -> float:
        """Returns the share of the sweeps of the healthy devices that the wire could carry."""
        left = 1.0 - self.bad.took / seconds
        if self.drawn.kind != "flooding":
            return left
        others = [one for one in self.drawn.plant.devices if one is not self.drawn.broken]
        needs = sum(one.load + one.load_of_proofs for one in others)
        left -= self.story.counts["writes"] * self.limits.worst_write / seconds
        return min(1.0, left / needs)

    def judge(self, since: float) -> None:
        plant, seconds = self.drawn.plant, now() - since - self.left
        could = self.could(seconds)
        least = could * KEPT
        if self.drawn.kind == "flooding" and could < 1.0:
            least = could * (KEPT_BY_PROOFS if self.bad.took < LITTLE * seconds else KEPT_DOUBTFUL)
        self.story.counts["most % taken"] = round(100 * self.bad.took / seconds)
        for one in self.healthy:
            reads = len(plant.reads(one, since))
            self.story.counts["sweeps"] += reads
            kept = reads * one.tags[0].every / seconds
            if kept < least:
                lost, most = 1 - kept, 1 - least
                self.broke(f"{one.name} was not read for {lost:.1%} of the time, not {most:.1%}")
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
