"""A line with simulated Vigor stations, and knobs for everything that can go wrong with it.

What the line tells, sends and hears is kept with its time, so that a test can ask afterwards.
"""

import asyncio
import random
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from gateway.device import Device
from gateway.errors import GatewayError, LineDown
from gateway.line import Line
from gateway.protocols.driver import AnyDriver, Span, Timing, Unit
from gateway.protocols.vigor import Vigor
from gateway.stations.station import Memory
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, Sample, Tag, Written
from gateway.transport import Ear, Port, open_simulator
from gateway.values import Layout, Value, parse_type
from gateway.wiretime import Wire

WIRE = Wire(19200, 10)
TURNAROUND = 0.005
SECOND = 1_000_000_000


def make_tag(
    text: str,
    driver: AnyDriver | None = None,
    *,
    device: str = "plc",
    name: str = "",
    **settings: Any,
) -> Tag:
    """A tag as the file would make it: `D100`, `M12`, `D7.3`; `type="float32"`."""
    driver = driver or Vigor(station=1)
    address = driver.address(text)
    unit = driver.areas[address.area].unit
    plain = {Unit.BIT: "bool", Unit.WORD: "int16", Unit.DWORD: "int32"}[unit]
    kind = parse_type(settings.pop("type", "bool" if address.bit is not None else plain))
    size = 1 if address.bit is not None or unit is not Unit.WORD else kind.words
    return Tag(
        device=device,
        name=name or text,
        text=text,
        address=address,
        span=Span(address.area, address.number, size),
        unit_kind=unit,
        layout=Layout(kind),
        **settings,
    )


def words(first: int, count: int, **settings: Any) -> list[Tag]:
    """`count` neighbouring words of D, unsigned."""
    return [make_tag(f"D{n}", type="uint16", **settings) for n in range(first, first + count)]


def clockwork(memory: Memory, numbers: Sequence[int]) -> None:
    """Words of D that say what time it is: milliseconds, each by its own offset."""
    for n in numbers:
        memory.animate("D", n, lambda now, n=n: clock_word(now, n))


def clock_word(now: float, n: int) -> int:
    return (int(now * 1000) + 1777 * n) % 65536


@dataclass
class Unruly:
    """A station that does not behave. Answers keep their order, as a PLC's do."""

    inner: VigorStation
    seed: int = 0
    late: Callable[[random.Random], float] = lambda _: 0.0  # seconds on top, drawn for each reply
    delay: float = 0.0  # what the simulated wire adds to the turnaround
    lose: float = 0.0  # share of replies that are lost
    cut: float = 0.0  # share of replies that break off
    wire: Wire = WIRE
    heard: list[tuple[float, bytes]] = field(default_factory=list)  # its requests
    lost: int = 0

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._until = 0.0

    @property
    def memory(self) -> Memory:
        return self.inner.memory

    @property
    def mute(self) -> bool:
        return self.inner.mute

    @mute.setter
    def mute(self, mute: bool) -> None:
        self.inner.mute = mute

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if data[1:3] == b"%02X" % self.inner.station:
            self.heard.append((now, data))
        replies = self.inner.hear(data, now)
        if not replies:
            return []
        if self._random.random() < self.lose:
            self.lost += 1
            return []
        if self._random.random() < self.cut:
            replies = [reply[: self._random.randrange(1, len(reply))] for reply in replies]
        self.delay = max(self.late(self._random), self._until - now)
        length = sum(map(len, replies)) * self.wire.character
        self._until = now + self.delay + length + TURNAROUND
        return replies


@dataclass
class Bench:
    """The port between line and wire, and what passed through it."""

    noise: float = 0.0  # share of bytes with one bit turned, both ways
    echo: bool = False  # a two-wire adapter: what is sent comes back
    before_echo: bytes = b""  # what its switching adds
    gone: str = ""  # why the port is not there
    seed: int = 0
    opened: list[float] = field(default_factory=list)  # every try
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    damaged: int = 0
    ear: Ear | None = None
    inner: Port | None = None

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    async def open(self, stations: Sequence[Any], wire: Wire, ear: Ear) -> "Bench":
        self.opened.append(_now())
        if self.gone:
            raise LineDown(self.gone)
        self.ear = ear
        self.inner = await open_simulator(stations, wire, self, turnaround=TURNAROUND)
        return self

    def write(self, data: bytes) -> None:
        if self.gone or self.inner is None:
            raise LineDown(self.gone or "closed")
        self.sent.append((_now(), data))
        if self.echo:
            arrives = _now() + len(data) * WIRE.character
            asyncio.get_running_loop().call_at(arrives, self.received, self.before_echo + data)
        self.inner.write(self._spoil(data))

    async def close(self) -> None:
        if self.inner is not None:
            await self.inner.close()
            self.inner = None

    def received(self, data: bytes) -> None:
        if self.ear is not None and self.inner is not None:
            self.ear.received(self._spoil(data))

    def lost(self, error: Exception) -> None:
        raise AssertionError("the simulator is never lost by itself")

    def vanish(self, why: str = "unplugged") -> None:
        self.gone = why
        if self.ear is not None:
            self.ear.lost(LineDown(why))

    def come_back(self) -> None:
        self.gone = ""

    def _spoil(self, data: bytes) -> bytes:
        if not self.noise:
            return data
        spoilt = bytearray(data)
        for i in range(len(spoilt)):
            if self._random.random() < self.noise:
                spoilt[i] ^= 1 << self._random.randrange(7)
                self.damaged += 1
        return bytes(spoilt)


@dataclass
class Plant:
    """One line, its devices and stations; an `Upstairs` that keeps everything."""

    devices: list[Device]
    stations: list[Unruly]
    bench: Bench
    wire: Wire = WIRE
    told: list[tuple[float, Sample]] = field(default_factory=list)
    lives: list[tuple[float, str, bool]] = field(default_factory=list)
    now: dict[Tag, Sample] = field(default_factory=dict)
    line: Line = field(init=False)

    def __post_init__(self) -> None:
        self.line = Line(
            "line",
            self.devices,
            self.wire,
            lambda ear: self.bench.open(self.stations, self.wire, ear),
            self,
            lambda: int(_now() * SECOND),
            echo=self.bench.echo,
            seed=self.bench.seed,
        )

    def samples(self, samples: Sequence[Sample]) -> None:
        for sample in samples:
            self.told.append((_now(), sample))
            self.now[sample.tag] = sample

    def alive(self, device: Device, alive: bool) -> None:
        self.lives.append((_now(), device.name, alive))

    # What tests ask

    def good(self, device: Device) -> bool:
        return all(tag in self.now and self.now[tag].quality is Quality.GOOD for tag in device.tags)

    def reads(self, device: Device, since: float = 0.0) -> list[float]:
        """When the device's first tag was read well."""
        tag = device.tags[0]
        return [
            at
            for at, sample in self.told
            if sample.tag is tag and sample.quality is Quality.GOOD and at >= since
        ]

    def turned(self, tag: Tag, quality: Quality, since: float) -> float:
        """The first moment from `since` on when the tag was told to be so."""
        return next(
            at
            for at, sample in self.told
            if at >= since and sample.tag is tag and sample.quality is quality
        )

    def reason(self, tag: Tag) -> Reason | None:
        return self.now[tag].reason

    def writes_sent(self, since: float = 0.0) -> list[tuple[float, bytes]]:
        return [(at, data) for at, data in self.bench.sent if data[3:4] in b"67" and at >= since]

    def submit(self, device: Device, tag: Tag, value: Value) -> "Outcome":
        outcome = Outcome(_now())
        self.line.submit(device, tag, tag.encode(value), outcome)
        return outcome


@dataclass
class Outcome:
    """What became of a write, and whether it was said once."""

    asked: float
    said: list[Written | GatewayError] = field(default_factory=list)
    at: float = 0.0

    def __call__(self, outcome: Written | GatewayError) -> None:
        self.said.append(outcome)
        self.at = _now()

    @property
    def once(self) -> Written | GatewayError:
        assert len(self.said) == 1, self.said
        return self.said[0]


def device(
    tags: Sequence[Tag],
    *,
    station: int = 1,
    name: str = "",
    guard: float = 0.5,
    wire: Wire = WIRE,
    **timing: Any,
) -> Device:
    driver = Vigor(station=station)
    times: Timing = replace(driver.timing, **timing)
    return Device(name or f"plc{station}", driver, wire, times, tuple(tags), guard)


def plant(devices: Sequence[Device], *, wire: Wire = WIRE, seed: int = 0, **bench: Any) -> Plant:
    """A station for every device; its knobs and the bench's can be turned at any time."""
    stations = [
        Unruly(VigorStation(d.driver.station), seed * 1000 + i, wire=wire)
        for i, d in enumerate(devices)
    ]
    return Plant(list(devices), stations, Bench(seed=seed, **bench), wire)


@asynccontextmanager
async def running(plant: Plant) -> AsyncIterator["asyncio.Task[None]"]:
    """The line's task, ended at the end. A task that ended by itself is an error."""
    task = asyncio.create_task(plant.line.run())
    try:
        yield task
    finally:
        ended = task.done()
        task.cancel()
        results = await asyncio.gather(task, return_exceptions=True)
        if ended and not isinstance(results[0], asyncio.CancelledError):
            raise AssertionError(f"the line ended: {results[0]!r}")


def _now() -> float:
    return asyncio.get_running_loop().time()
