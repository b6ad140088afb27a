"""Device servers that repeat a reply, a second master, and stations that are held up."""

import asyncio
import random
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import pytest

from gateway.engine.device.health import State
from gateway.engine.device.reply_shapes import WARY_FOR
from gateway.errors import Busy, LineDown, Refused, Unclear
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver, Span
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from gateway.tags import Quality, Tag, WriteRule
from tests.line.device_server import GUARD, TURNAROUND, DeviceServer, behind, by_protocol
from tests.sim.bench import WIRE
from tests.sim.plant import Plant, made_device, make_tag, running
from tests.sim.virtual import now, on_virtual_time


@dataclass
class Repeater(DeviceServer):
    """Sends the replies in `twice` (by number) a second time, `after` seconds later."""

    twice: set[int] = field(default_factory=set)
    after: float = 0.0
    replies: int = 0

    def lacks(self, *places: tuple[str, int]) -> None:
        """The addresses that the station lacks from now on."""
        self._station.memory.holes = set(places)

    def received(self, data: bytes) -> None:
        super().received(data)
        self.replies += 1
        if self.replies in self.twice:
            loop = asyncio.get_running_loop()
            loop.call_later(self.latency + self.after, super().received, data)


def area_of(driver: AnyDriver) -> str:
    return "holding:" if driver.protocol.startswith("modbus") else "D"


def numbered(driver: AnyDriver, *numbers: int, every: float = 0.01, **settings: Any) -> list[Tag]:
    """Words far apart, each a block of its own; each holds its own number."""
    return [
        make_tag(f"{area_of(driver)}{n}", driver, type="uint16", every=every, **settings)
        for n in numbers
    ]


def wrong_values(line: Plant) -> list[tuple[float, str, object]]:
    good = [(at, sample) for at, sample in line.reported if sample.quality is Quality.GOOD]
    return [
        (at, sample.tag.text, sample.value)
        for at, sample in good
        if sample.value != sample.tag.address.number
    ]


@by_protocol
@pytest.mark.parametrize("after", [0.0, 0.01, 0.03])
@on_virtual_time
async def test_no_value_moves_to_the_next_tag_after_a_repeated_reply(
    driver: AnyDriver, after: float
) -> None:
    server = Repeater(twice={50, 99, 231}, after=after)
    tags = numbered(driver, 100, 200, 300, 400, 500)
    line, dev, memory = behind(server, driver, *tags)
    for number in range(1000):
        memory.write(area_of(driver).strip(":"), number, [number])
    async with running(line):
        await asyncio.sleep(20)  # each read has a proof after the 50th reply
        assert server.replies > 240
        assert dev.state is State.ONLINE
        assert line.good(dev)
    assert wrong_values(line) == []


@dataclass
class Hasty(Repeater):
    """Sends its copy with the next request, so many seconds before the station replies."""

    sooner: float = 0.0
    kept: bytes = b""

    def received(self, data: bytes) -> None:
        DeviceServer.received(self, data)
        self.replies += 1
        if self.replies in self.twice:
            self.kept = data

    def write(self, data: bytes) -> None:
        super().write(data)
        if self.kept:
            loop, copy, self.kept = asyncio.get_running_loop(), self.kept, b""
            after = (len(data) + len(copy)) * WIRE.character + TURNAROUND - self.sooner
            loop.call_later(after, DeviceServer.received, self, copy)


@by_protocol
@pytest.mark.parametrize(("sooner", "wrong"), [(0.6, 0), (0.45, 1)])
@on_virtual_time
async def test_a_reply_that_comes_sooner_than_the_station_can_reply_needs_a_proof(
    driver: AnyDriver, sooner: float, wrong: int
) -> None:
    """Both blocks can only be read alone: the copy fits the next request. If it is not too soon,
    the own reply is that for the request after it; `hostile` seed 2700067."""
    server, area = Hasty(twice={160}, sooner=sooner * TURNAROUND), area_of(driver).strip(":")
    tags = numbered(driver, 100, 200)
    line, dev, memory = behind(server, driver, *tags)
    for number in (100, 200):
        memory.write(area, number, [number])
    memory.holes = {(area, n) for n in range(300) if n not in (100, 200)}
    async with running(line):
        while server.replies <= 160:
            await asyncio.sleep(0.1)
        after = now()
        await asyncio.sleep(20)
    assert dev.shapes is not None
    assert dev.shapes.is_wary
    assert all(line.reads_of(tag, after) for tag in tags)
    assert len(wrong_values(line)) <= wrong


@dataclass
class SecondMaster(DeviceServer):
    """Before every third reply, the gateway hears an older one of the same length.

    Another master asked for it: it has the shape that the gateway waits for.
    """

    begins_at: float = 0.0
    heard: int = 0
    older: dict[int, bytes] = field(default_factory=dict)  # by length

    def received(self, data: bytes) -> None:
        older = self.older.get(len(data), b"")
        self.older[len(data)] = data
        self.heard += 1
        if older and now() >= self.begins_at and self.heard % 3 == 0:
            super().received(older)
        super().received(data)


@by_protocol
@pytest.mark.parametrize("size", [1, 9])
@on_virtual_time
async def test_a_second_master_makes_one_wrong_scan_at_most(driver: AnyDriver, size: int) -> None:
    """It asks for the same shapes. The first reply to no request is the evidence."""
    server = SecondMaster(begins_at=now() + 10)
    starts = (100, 200, 300, 400, 500)
    words = [start + n for start in starts for n in range(size)]
    line, dev, memory = behind(server, driver, *numbered(driver, *words, every=0.1))
    for number in range(1000):
        memory.write(area_of(driver).strip(":"), number, [number])
    async with running(line):
        await asyncio.sleep(70)
        assert len({at for at, _, _ in wrong_values(line)}) <= 1
        server.begins_at = inf
        await asyncio.sleep(20)
        assert line.good(dev)


@by_protocol
@on_virtual_time
async def test_the_diagnosis_says_that_the_station_answers_twice(driver: AnyDriver) -> None:
    server = Repeater(twice={50})
    line, dev, _ = behind(server, driver, *numbered(driver, 100, 200, 300))
    async with running(line):
        while server.replies < 50:
            await asyncio.sleep(0.01)
        await asyncio.sleep(1)
        assert "Answers twice: a second master" in dev.diagnosis()
        await asyncio.sleep(120)
        assert dev.diagnosis() == ""


@by_protocol
@pytest.mark.parametrize(
    ("after", "every"), [(0.005, 0.02), (0.03, 0.02), (0.03, 0.2), (0.06, 0.2)]
)
@on_virtual_time
async def test_no_read_on_demand_gets_another_reply_and_no_tag_gets_its_own(
    driver: AnyDriver, after: float, every: float
) -> None:
    """Programs at doors and `peek` read other addresses of the same length between the polls."""
    server = Repeater(after=after)
    line, dev, memory = behind(server, driver, *numbered(driver, 100, 200, 300, every=every))
    area = area_of(driver).strip(":")
    for number in range(1000):
        memory.write(area, number, [number])
    wrong, found = list[tuple[int, str]](), 0
    async with running(line):
        await asyncio.sleep(1)
        for number in range(600, 640):
            server.twice = {server.replies + n for n in range(1, 1 + number % 3)}
            with suppress(Unclear, Busy):
                read = await line.line.peek(dev, Span(area, number, 1), 1.0)
                found += 1
                if read != str(number):
                    wrong.append((number, read))
            await asyncio.sleep(0.017 * (number % 5))
    assert wrong == []
    assert wrong_values(line) == []
    assert found > 10


@by_protocol
@pytest.mark.parametrize("after", [0.0, 0.005, 0.02, 0.05, 0.07])
@on_virtual_time
async def test_a_repeated_acknowledgement_confirms_no_other_write(
    driver: AnyDriver, after: float
) -> None:
    """The second write is refused: the PLC no longer has the address."""
    target = make_tag(f"{area_of(driver)}100", driver, name="target", write=WriteRule())
    place = (area_of(driver).strip(":"), 100)
    server = Repeater(after=after)
    line, dev, memory = behind(server, driver, *numbered(driver, 200, 300, 400), target)
    async with running(line):
        for value in range(12):
            await asyncio.sleep(1.0 + 0.013 * value)
            server.twice = {server.replies + n for n in (1, 2, 3)}
            with suppress(Unclear):  # soon after the refusal before
                await line.line.write(dev, target, [value])
            server.lacks(place)
            second = line.submit(dev, target, 1000 + value)
            await asyncio.sleep(3)
            server.lacks()
            assert isinstance(second.once, Refused | Unclear)
            assert memory.read(*place) == [value]


@dataclass
class TwoLinks(DeviceServer):
    """A port with two radio links behind it: the replies of station 2 are held up at times."""

    stations: list[Any] = field(default_factory=list)
    held: list[bytes] | None = None  # replies of station 2 that wait

    async def open(self, stations: Any, wire: Any, ear: Any) -> "TwoLinks":
        self.ear, self.stations = ear, list(stations)
        self.flows.set()
        self._task = asyncio.create_task(self._serve())
        return self

    async def _serve(self) -> None:
        while True:
            request = await self._queue.get()
            await asyncio.sleep(len(request) * WIRE.character + 0.005)
            for number, station in enumerate(self.stations, 1):
                for answer in station.hear(request, now()):
                    await asyncio.sleep(len(answer) * WIRE.character)
                    if number == 2 and self.held is not None:
                        self.held.append(answer)
                    else:
                        self.received(answer)

    async def release(self, pause: float) -> None:
        """Delivers them in order, with a pause after each of the first; the rest at once."""
        for _ in range(len(self.held or [])):
            self.received(self.held.pop(0))  # type: ignore[union-attr]
            await asyncio.sleep(pause)
        held, self.held = self.held or [], None
        for answer in held:
            self.received(answer)


@pytest.mark.parametrize("pause", [0.0, 0.05, 0.35])
@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii, Vigor])
@on_virtual_time
async def test_other_stations_prove_nothing_for_one_that_is_held_up(
    kind: Any, pause: float
) -> None:
    devices = []
    server = TwoLinks()
    for number in (1, 2):
        driver = kind(station=number)
        tags = numbered(driver, 100, 101, 200, 300, 301, 302, every=0.5)
        timing = replace(driver.timing, retries=6, reply_timeout=0.3)
        devices.append(made_device(f"plc{number}", driver, WIRE, timing, tags, GUARD))
    stations = [station_for(device.driver, []) for device in devices]
    for station in stations:
        for n in range(1000):
            station.memory.write(area_of(devices[0].driver).strip(":"), n, [n])
    line = Plant(devices, stations, server, WIRE)  # type: ignore[arg-type]
    async with running(line):
        for phase in range(15):
            await asyncio.sleep(10 + 0.13 * phase)
            server.held = []
            await asyncio.sleep(2.0 + 2.3 * phase)
            await server.release(pause)
        await asyncio.sleep(20)
        assert all(line.good(device) for device in devices)
    assert wrong_values(line) == []


@dataclass
class Serial(DeviceServer):
    """A device server whose serial side goes on while the connection is reset."""

    async def open(self, stations: Any, wire: Any, ear: Any) -> "Serial":
        self.ear, (self._station,) = ear, stations
        if self._task is None:
            self.flows.set()
            self._task = asyncio.create_task(self._serve())
        return self

    async def close(self) -> None:
        self.ear = None

    def reset(self) -> None:
        ear, self.ear = self.ear, None
        if ear is not None:
            ear.lost(LineDown("connection reset"))


@pytest.mark.parametrize("pause", [0.7, 0.3])  # 0.3: some resets come before any time-out
@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii, Vigor])
@on_virtual_time
async def test_a_request_that_a_reset_cut_off_is_still_outstanding(kind: Any, pause: float) -> None:
    """The serial side stalls, and its old replies arrive on the new connection."""
    driver = kind(station=1)
    server = Serial()
    line, dev, memory = behind(server, driver, *numbered(driver, 100, 200, 300, 301, every=0.2))
    for number in range(1000):
        memory.write(area_of(driver).strip(":"), number, [number])
    async with running(line):
        for phase in range(12):
            await asyncio.sleep(8 + 0.031 * phase)
            server.flows.clear()
            for _ in range(3 + phase % 4):
                await asyncio.sleep(pause)
                server.reset()
            await asyncio.sleep(0.5)
            server.flows.set()
        await asyncio.sleep(20)
        assert line.good(dev)
    assert wrong_values(line) == []


@by_protocol
@pytest.mark.parametrize("seed", [22, 54])
@on_virtual_time
async def test_resets_at_any_moment_of_a_stall_make_no_wrong_value(
    driver: AnyDriver, seed: int
) -> None:
    draw = random.Random(seed)
    starts = [100 * number for number in range(1, draw.randint(3, 7))]
    words = [start + n for start in starts for n in range(draw.choice([1, 1, 1, 2, 3]))]
    server = Serial()
    every = draw.choice([0.05, 0.2, 1.0])
    line, dev, memory = behind(server, driver, *numbered(driver, *words, every=every))
    for number in range(1000):
        memory.write(area_of(driver).strip(":"), number, [number])
    async with running(line):
        for _ in range(20):
            await asyncio.sleep(draw.uniform(2, 12))
            server.flows.clear()
            for _ in range(draw.randint(1, 6)):
                await asyncio.sleep(draw.uniform(0.01, draw.choice([0.2, 0.6, 2.0])))
                server.reset()
            await asyncio.sleep(draw.uniform(0, 2))
            server.flows.set()
        await asyncio.sleep(40)
        assert line.good(dev)
    assert wrong_values(line) == []


@by_protocol
@pytest.mark.parametrize("seed", range(8, 12))
@on_virtual_time
async def test_a_gateway_that_starts_takes_no_reply_to_an_earlier_process(
    driver: AnyDriver, seed: int
) -> None:
    """The process ends while the device server is stalled, and the next one finds its requests."""
    draw = random.Random(seed)
    words = [
        100 * n + k for n in range(1, draw.randint(3, 6)) for k in range(draw.choice([1, 1, 2]))
    ]
    server, every = Serial(), draw.choice([0.05, 0.2, 1.0])
    for run in range(12):
        tags = numbered(driver, *words, every=every)
        line, dev, memory = behind(server, driver, *tags, inherits=True)
        for number in range(1000):
            memory.write(area_of(driver).strip(":"), number, [number])
        async with running(line):
            if run:
                await asyncio.sleep(draw.uniform(0.0, 1.5))
                server.flows.set()
            await asyncio.sleep(draw.uniform(3, 8))
            assert line.good(dev)
            server.flows.clear()
            await asyncio.sleep(draw.choice([draw.uniform(0.02, 0.4), draw.uniform(0.1, 3)]))
        assert wrong_values(line) == []


@on_virtual_time
async def test_a_monitor_list_is_not_used_while_a_station_answers_twice() -> None:
    """All replies to a list have one shape: a copy would be the reply to the next read."""
    driver = ComputerLink(station=1, monitor=True)
    server = Repeater(after=0.03)
    tags = numbered(driver, 100, 500, 900, 1300, every=0.1)
    line, dev, memory = behind(server, driver, *tags)

    def scan(at: float) -> int:
        return int(at * 1000) & 0xFFFF

    for tag in tags:
        memory.animate("D", tag.span.start, scan)
    async with running(line):
        await asyncio.sleep(3)
        assert any(block.listed for block in dev.blocks)
        server.twice = set(range(server.replies, server.replies + 10_000, 7))
        await asyncio.sleep(12)
        assert not any(block.listed for block in dev.blocks)
        assert dev.shapes is not None
        assert dev.shapes.answers_twice
        server.twice.clear()
        dev.shapes.extra_at -= WARY_FOR  # as if the last one were so long ago
        dev.monitor.again -= WARY_FOR
        await asyncio.sleep(60)
        assert any(block.listed for block in dev.blocks)
    good = [sample for _, sample in line.reported if sample.quality is Quality.GOOD]
    times = [(sample.time / 1e9, int(str(sample.value))) for sample in good]
    old = {at for at, value in times if (scan(at) - value) % 65536 > 60}
    assert len(old) <= 1, old
