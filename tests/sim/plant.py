"""A line with simulated Vigor stations, and knobs for its faults.

It keeps all samples, state changes and bytes of the line with their times.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from gateway.engine.device.device import Device
from gateway.engine.device.device_settings import DeviceSettings
from gateway.engine.device.health import State
from gateway.engine.engine import Engine
from gateway.engine.jobs import requests
from gateway.errors import GatewayError
from gateway.line.line import Line
from gateway.line.send_permit import SendPermit
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import AnyDriver, Span, Timing, Unit
from gateway.protocols.vigor import Vigor
from gateway.stations.station import Memory
from gateway.stations.vigor import VigorStation
from gateway.tags import Quality, Reason, Sample, Tag
from gateway.values import Layout, Value, parse_type
from tests.sim.bench import WIRE, Bench, Unruly
from tests.tag_settings import grouped

SECOND = 1_000_000_000


def make_tag(
    text: str,
    driver: AnyDriver | None = None,
    *,
    device: str = "plc",
    name: str = "",
    **settings: Any,
) -> Tag:
    """Makes a tag as the file would: `D100`, `M12`, `D7.3`; `type="float32"`."""
    driver = driver or Vigor(station=1)
    address = driver.address(text)
    unit = driver.areas[address.area].unit
    plain = {Unit.BIT: "bool", Unit.WORD: "int16", Unit.DWORD: "int32"}[unit]
    kind = parse_type(settings.pop("type", "bool" if address.bit is not None else plain))
    size = 1 if address.bit is not None or unit is not Unit.WORD else kind.words
    if unit is Unit.BIT and kind.count:
        size = kind.count
    return Tag(
        device=device,
        name=name or text,
        text=text,
        address=address,
        span=Span(address.area, address.number, size),
        unit_kind=unit,
        layout=Layout(kind),
        **grouped(**settings),
    )


def words(first: int, count: int, **settings: Any) -> list[Tag]:
    """`count` neighbouring words of D, unsigned."""
    return [make_tag(f"D{n}", type="uint16", **settings) for n in range(first, first + count)]


def clockwork(memory: Memory, numbers: Sequence[int]) -> None:
    """Makes words of D count the milliseconds, each with its own offset."""
    for n in numbers:
        memory.animate("D", n, partial(clock_word, n=n))


def clock_word(now: float, n: int) -> int:
    return (int(now * 1000) + 1777 * n) % 65536


@dataclass
class Plant:
    """One line, its devices and stations; a `SampleSink` that keeps everything.

    `listeners` receive the samples first.
    """

    devices: list[Device]
    stations: list[Unruly]
    bench: Bench
    wire: WireTiming = WIRE
    reported: list[tuple[float, Sample]] = field(default_factory=list)
    online_changes: list[tuple[float, str, bool]] = field(default_factory=list)
    now: dict[Tag, Sample] = field(default_factory=dict)
    echo_in_file: bool = True  # False: an adapter echoes, and the file does not mention it
    listeners: list[Callable[[Sequence[Sample]], None]] = field(default_factory=list)
    duty: SendPermit | None = None
    inherits: bool = False
    line: Line = field(init=False)

    def __post_init__(self) -> None:
        engine = Engine("line", self.devices, self.wire, self.bench.seed)
        if self.inherits:
            engine.inherits()
        self.line = Line(
            engine,
            lambda receiver: self.bench.open(self.stations, self.wire, receiver),
            self,
            echo=(self.bench.echo and self.echo_in_file) or None,
            wall=lambda: int(_now() * SECOND),
            duty=self.duty,
        )

    def samples(self, samples: Sequence[Sample]) -> None:
        for listener in self.listeners:
            listener(samples)
        for sample in samples:
            self.reported.append((_now(), sample))
            self.now[sample.tag] = sample

    def online(self, device: Device, online: bool) -> None:
        self.online_changes.append((_now(), device.name, online))

    # For assertions

    def good(self, device: Device) -> bool:
        return all(tag in self.now and self.now[tag].quality is Quality.GOOD for tag in device.tags)

    def reads(self, device: Device, since: float = 0.0) -> list[float]:
        """The times of good reads of the device's first tag."""
        return self.reads_of(device.tags[0], since)

    def reads_of(self, tag: Tag, since: float = 0.0) -> list[float]:
        return [
            at
            for at, sample in self.reported
            if sample.tag is tag and sample.quality is Quality.GOOD and at >= since
        ]

    def turned(self, tag: Tag, quality: Quality, since: float) -> float:
        """The first time from `since` on when the tag had this quality."""
        return next(
            at
            for at, sample in self.reported
            if at >= since and sample.tag is tag and sample.quality is quality
        )

    def state(self, device: Device) -> State:
        """The device's state now. A type checker takes an attribute read twice for unchanged."""
        return device.state

    def reason(self, tag: Tag) -> Reason | None:
        return self.now[tag].reason

    def writes_sent(self, since: float = 0.0) -> list[tuple[float, bytes]]:
        return [(at, data) for at, data in self.bench.sent if data[3:4] in b"67" and at >= since]

    def submit(self, device: Device, tag: Tag, value: Value) -> "Outcome":
        return Outcome(_now()).of(self.line.write(device, tag, tag.encode(value)))

    def command(self, device: Device, name: str, argument: str = "") -> "Outcome":
        return Outcome(_now()).of(self.line.command(device, name, argument))


@dataclass
class Outcome:
    """The outcome of a request, and its time."""

    asked: float
    outcomes: list[requests.Outcome] = field(default_factory=list)
    at: float = 0.0

    def of(self, future: "asyncio.Future[Any]") -> "Outcome":
        if future.done():
            self._take(future)
        else:
            future.add_done_callback(self._take)
        return self

    def _take(self, future: "asyncio.Future[Any]") -> None:
        error = future.exception()
        if error is not None and not isinstance(error, GatewayError):
            raise error
        self.outcomes.append(future.result() if error is None else error)
        self.at = _now()

    @property
    def once(self) -> Any:
        """The one outcome."""
        (outcome,) = self.outcomes
        return outcome


def device(
    tags: Sequence[Tag],
    *,
    station: int = 1,
    name: str = "",
    guard: float = 0.5,
    wire: WireTiming = WIRE,
    verify_reads: int = 1,
    **timing: Any,
) -> Device:
    driver = Vigor(station=station)
    times: Timing = replace(driver.timing, **timing)
    name = name or f"plc{station}"
    return made_device(name, driver, wire, times, tags, guard, verify_reads=verify_reads)


def made_device(
    name: str,
    driver: AnyDriver,
    wire: WireTiming,
    timing: Timing,
    tags: Sequence[Tag],
    late_guard: float = 0.5,
    **settings: Any,
) -> Device:
    """Makes a device as the file would."""
    known = DeviceSettings(
        name=name,
        driver=driver,
        timing=timing,
        tags=tuple(tags),
        late_guard=late_guard,
        **grouped(**settings),
    )
    return Device(known, wire)


def plant(
    devices: Sequence[Device],
    *,
    wire: WireTiming = WIRE,
    seed: int = 0,
    duty: SendPermit | None = None,
    **bench: Any,
) -> Plant:
    """Makes a station for every device. The knobs of station and bench work at any time."""
    stations = [
        Unruly(VigorStation(d.driver.station), seed * 1000 + i, wire=wire)
        for i, d in enumerate(devices)
    ]
    return Plant(list(devices), stations, Bench(seed=seed, **bench), wire, duty=duty)


@asynccontextmanager
async def running(plant: Plant) -> AsyncIterator["asyncio.Task[None]"]:
    """Runs the line's task. Raises when the task ended by itself."""
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
