"""Modbus on a whole line on virtual time: late and silent slaves, broadcasts, echoes, exceptions,
three dialects on one wire, several questions open at once."""

import asyncio
import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import pytest
from structlog.testing import capture_logs

from gateway.engine.device import Device
from gateway.engine.health import State
from gateway.errors import Evidence, LineDown, Unclear
from gateway.planning.wire_timing import NETWORK_BAUD, WireTiming
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import (
    Frame,
    MbapCodec,
    ModbusAscii,
    ModbusRtu,
    ModbusTcp,
    RtuSlaveCodec,
)
from gateway.stations.modbus import ModbusStation
from gateway.tags import Quality, Reason, Tag, WriteResult, WriteRule
from gateway.transport import Receiver
from tests.sim.bench import WIRE, Bench, Unruly
from tests.sim.plant import Plant, clock_word, made_device, make_tag, running
from tests.sim.virtual import on_virtual_time
from tests.sim.witness import Witness
from tests.vectors import vectors

NETWORK = WireTiming(NETWORK_BAUD, 10)
Driver = ModbusRtu | ModbusAscii | ModbusTcp


def now() -> float:
    return asyncio.get_running_loop().time()


def slave(
    driver: Driver,
    tags: Sequence[Tag],
    *,
    wire: WireTiming = WIRE,
    guard: float = 0.3,
    **timing: Any,
) -> Device:
    times = replace(driver.timing, **timing)
    return made_device(f"slave{driver.station}", driver, wire, times, tuple(tags), guard)


def registers(driver: AnyDriver, *sizes: int, every: float = 0.2) -> list[Tag]:
    """Blocks of holding registers of these sizes, far apart."""
    return [
        make_tag(f"holding:{number}", driver, type="uint16", every=every)
        for block, size in enumerate(sizes)
        for number in range(1000 * block, 1000 * block + size)
    ]


def station_of(driver: Driver, **settings: Any) -> ModbusStation:
    framing: Literal["rtu", "ascii", "tcp"]
    match driver:
        case ModbusRtu():
            framing = "rtu"
        case ModbusAscii():
            framing = "ascii"
        case ModbusTcp():
            framing = "tcp"
    return ModbusStation(
        station=driver.station, framing=framing, dialect=driver.addressing, **settings
    )


def plant(
    devices: Sequence[Device],
    *,
    wire: WireTiming = WIRE,
    seed: int = 0,
    bench: Bench | None = None,
    echo_in_file: bool = True,
    **station: Any,
) -> Plant:
    """Each device with its station, whose holding registers tell the time in milliseconds."""
    stations = []
    for number, device in enumerate(devices):
        inner: Any = station_of(device.driver, **station)  # type: ignore[arg-type]  # ours are Modbus
        stations.append(Unruly(inner, seed * 1000 + number, wire=wire))
        for tag in device.tags:
            if tag.address.area == "holding" and tag.write is None:
                n = tag.address.number
                inner.memory.animate("holding", n, lambda at, n=n: clock_word(at, n))
    return Plant(
        list(devices),
        stations,
        bench or Bench(seed=seed),
        wire,
        echo_in_file=echo_in_file,
    )


def good_reads(plant: Plant, since: float = 0.0) -> int:
    return sum(len(plant.reads(device, since)) for device in plant.devices)


# Late and silent slaves


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("sizes", [(3, 3, 3), (2, 3, 4)])
@on_virtual_time
async def test_late_replies_never_make_a_wrong_value(
    kind: type[ModbusRtu | ModbusAscii], share: float, sizes: tuple[int, ...]
) -> None:
    """Late by 50 to 150 ms beyond the time-out; the four cases of a framing are 10,000 reads."""
    timeout, drivers = 0.3, [kind(station=n) for n in (1, 2)]
    devices = [slave(d, registers(d, *sizes), reply_timeout=timeout) for d in drivers]
    line = plant(devices, seed=int(share * 100))

    def late(chance: random.Random) -> float:
        return timeout + chance.uniform(0.05, 0.15) if chance.random() < share else 0.0

    for station in line.stations:
        station.late = late
    witness = Witness(line)
    async with running(line):
        for _ in range(60):
            await asyncio.sleep(60)
            if witness.right >= 2_500 * 3:  # values, three to a read
                break
    assert witness.wrong == []
    assert sum(device.record.exchanges for device in devices) >= 2_500
    assert witness.right >= 2_500 * 3
    assert sum(device.record.late for device in devices) > 20


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@pytest.mark.parametrize("every", [0.05, 1.0])
@on_virtual_time
async def test_four_slaves_keep_95_percent_of_their_reads_beside_a_silent_one(
    kind: type[ModbusRtu | ModbusAscii], every: float
) -> None:
    async def reads(numbers: Sequence[int]) -> int:
        drivers = [kind(station=n) for n in numbers]
        line = plant([slave(d, registers(d, 8, every=every), guard=0.5) for d in drivers])
        for station in line.stations:
            station.mute = station.inner.station == 5
        async with running(line):
            await asyncio.sleep(10)
            settled = now()
            await asyncio.sleep(60)
        return good_reads(line, settled)

    assert await reads((1, 2, 3, 4, 5)) >= 0.95 * await reads((1, 2, 3, 4))


# Broadcasts


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@on_virtual_time
async def test_a_broadcast_is_written_and_nothing_is_waited_for_but_the_turnaround(
    kind: type[ModbusRtu | ModbusAscii],
) -> None:
    everybody, ears = kind(station=0), [kind(station=n) for n in (1, 2)]
    to_all = [
        make_tag("holding:4", everybody, type="uint32", device="all", write=WriteRule()),
        make_tag("coil:16", everybody, device="all", write=WriteRule()),
    ]
    devices = [slave(d, registers(d, 20, every=0.02)) for d in ears]
    devices.append(slave(everybody, to_all))
    line = plant(devices)
    async with running(line):
        await asyncio.sleep(2)
        assert devices[2].record.exchanges == 0
        for tag, value in ((to_all[0], 0x87654321), (to_all[1], True)):
            sent, asked = len(line.bench.sent), now()
            outcome = line.submit(devices[2], tag, value)
            await asyncio.sleep(1)
            assert isinstance(outcome.once, WriteResult)
            assert (outcome.once.acknowledged, outcome.once.verified) == (False, False)
            assert outcome.at - asked < 0.1  # reply_timeout is 0.5 s
            at = next(i for i, (_, data) in enumerate(line.bench.sent[sent:]) if is_to_all(data))
            (begin, data), (after, _) = line.bench.sent[sent + at : sent + at + 2]
            assert 0.1 <= after - (begin + len(data) * WIRE.character) < 0.11
            if kind is ModbusRtu:
                assert data == vector({4: "modbus-rtu-005", 16: "modbus-rtu-054"}[data[3]])
        for station in line.stations[:2]:
            assert station.memory.read("holding", 4, 2) == [0x4321, 0x8765]
            assert station.memory.read("coil", 16) == [1]
        assert all(line.good(device) for device in devices[:2])


def is_to_all(data: bytes) -> bool:
    return data[0] == 0 or data.startswith(b":00")


def vector(name: str) -> bytes:
    return next(v.frame for v in vectors("modbus-rtu") if v.id == name)


# Exceptions


@dataclass
class Twisted:
    """Between wire and station: its answers are not what they should be."""

    inner: ModbusStation
    twist: Callable[[bytes], bytes]  # PDU -> PDU
    answered: list[float] = field(default_factory=list)

    @property
    def station(self) -> int:
        return self.inner.station

    def hear(self, data: bytes, at: float) -> list[bytes]:
        pdus = [reply[1:-2] for reply in self.inner.hear(data, at)]
        self.answered += [at] * len(pdus)
        ear = RtuSlaveCodec(self.station)
        return [ear.encode(Frame(self.station, self.twist(pdu))) for pdu in pdus]


def twisted(line: Plant, number: int, twist: Callable[[bytes], bytes]) -> Twisted:
    """From now on the station answers like this."""
    station: Any = line.stations[number]
    station.inner = Twisted(station.inner, twist)
    twisted: Twisted = station.inner
    return twisted


@pytest.mark.parametrize("code", [5, 6])
@on_virtual_time
async def test_a_busy_slave_is_left_alone_longer_each_time(code: int) -> None:
    drivers = [ModbusRtu(station=n) for n in (1, 2)]
    devices = [slave(d, registers(d, 10, every=5.0 if d.station == 1 else 0.1)) for d in drivers]
    line = plant(devices)
    async with running(line):
        await asyncio.sleep(1)
        busy = twisted(line, 0, lambda pdu: bytes((pdu[0] | 0x80, code)))
        start = now()
        await asyncio.sleep(6)
        pauses = [b - a for a, b in itertools.pairwise(busy.answered)]
        assert 0.2 <= pauses[0] < 0.3
        assert 0.4 <= pauses[1] < 0.5
        assert line.reason(devices[0].tags[0]) is Reason.REFUSED
        assert devices[0].record.refusals[f"0{code}"] == len(busy.answered)
        assert devices[0].state is State.ONLINE
        assert len(line.reads(devices[1], start)) >= 0.95 * 60
        busy.twist = lambda pdu: pdu
        await asyncio.sleep(6)
        assert line.good(devices[0])


@on_virtual_time
async def test_exception_02_is_halved_down_to_the_registers_that_are_not_there() -> None:
    driver = ModbusRtu(station=1)
    dev = slave(driver, registers(driver, 60, every=0.5))
    line = plant([dev], holes=[("holding", 23, 24), ("holding", 59, 59)])
    bad = {dev.tags[n] for n in (23, 24, 59)}
    async with running(line):
        await asyncio.sleep(3)
        for tag in dev.tags:
            if tag in bad:
                assert line.reason(tag) is Reason.REFUSED
            else:
                assert line.now[tag].quality is Quality.GOOD
        assert [block.span.size for block in dev.blocks] == [23, 1, 1, 34, 1]
        settled = dev.record.refusals["02"]
        await asyncio.sleep(60)
        assert dev.record.refusals["02"] == settled


# Dialects


@pytest.mark.parametrize(
    ("addressing", "text", "area", "done"),
    [("vigor", "D300", "D", True), ("plain", "holding:300", "holding", False)],
)
@on_virtual_time
async def test_function_06_answered_with_address_0_is_done_for_vigor_alone(
    addressing: Any, text: str, area: str, done: bool
) -> None:
    driver = ModbusRtu(station=1, addressing=addressing)
    tag = make_tag(text, driver, type="uint16", write=WriteRule())
    dev = slave(driver, [tag])
    line = plant([dev])
    memory = line.stations[0].memory
    twisted(line, 0, lambda pdu: pdu[:1] + bytes(2) + pdu[3:] if pdu[0] == 6 else pdu)
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(dev, tag, 4711)
        await asyncio.sleep(3)
        assert isinstance(outcome.once, WriteResult if done else Unclear)
        assert memory.read(area, 300) == [4711]


@dataclass
class Listening(Bench):
    """Keeps when something was heard as well."""

    heard: list[float] = field(default_factory=list)

    def received(self, data: bytes) -> None:
        self.heard.append(now())
        super().received(data)


@on_virtual_time
async def test_three_dialects_share_one_rtu_line_and_ex485lnk_has_its_silence() -> None:
    names = {"vigor": ("D100", "M5"), "k120s": ("D0100", "M0010"), "ex485lnk": ("BFM#4", "BFM#5")}
    devices = []
    for number, (addressing, texts) in enumerate(names.items(), 1):
        driver = ModbusRtu(station=number, addressing=addressing)  # type: ignore[arg-type]  # of the table
        tags = [make_tag(text, driver, every=0.1, write=WriteRule()) for text in texts]
        devices.append(slave(driver, tags))
    bench = Listening()
    line = plant(devices, bench=bench)
    async with running(line):
        await asyncio.sleep(5)
        for device in devices:
            first = device.tags[0]
            outcome = line.submit(device, first, 321)
            await asyncio.sleep(0.5)
            assert isinstance(outcome.once, WriteResult)
            assert line.now[first].value == 321
        await asyncio.sleep(25)
    assert all(line.good(device) and not device.record.failures for device in devices)
    assert all(len(line.reads(device)) > 250 for device in devices)
    for station, silence in ((1, 3.5 * WIRE.character), (2, 3.5 * WIRE.character), (3, 0.010)):
        quiet = [
            at - max(heard for heard in bench.heard if heard < at)
            for at, data in bench.sent[50:400]
            if data[0] == station
        ]
        assert len(quiet) > 50
        assert silence - 1e-9 <= min(quiet) < silence + 0.003


# Echoes


@on_virtual_time
async def test_on_an_echoing_line_a_silent_slave_does_not_acknowledge_by_its_echo() -> None:
    """The good answer to functions 05 and 06 is the request itself."""
    driver = ModbusRtu(station=1)
    tags = [
        make_tag("holding:5", driver, type="uint16", write=WriteRule()),
        make_tag("coil:5", driver, write=WriteRule()),
    ]
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(echo=True))
    async with running(line):
        await asyncio.sleep(5)
        for tag, value in ((tags[0], 1234), (tags[1], True)):
            done = line.submit(dev, tag, value)
            await asyncio.sleep(0.5)
            assert isinstance(done.once, WriteResult)
        assert not dev.record.failures
        for tag, value in ((tags[0], 4321), (tags[1], False)):
            line.stations[0].mute = True
            lost = line.submit(dev, tag, value)
            await asyncio.sleep(1.5)
            assert isinstance(lost.once, Unclear)
            line.stations[0].mute = False
            await asyncio.sleep(70)
        assert dev.record.failures[Evidence.SILENCE] >= 2
        assert [line.now[tag].value for tag in tags] == [1234, True]  # a mute slave obeys nothing


def writable(driver: Driver) -> tuple[Tag, Tag]:
    return (
        make_tag("holding:5", driver, type="uint16", write=WriteRule()),
        make_tag("coil:5", driver, write=WriteRule()),
    )


@pytest.mark.parametrize("driver", [ModbusRtu(station=1), ModbusAscii(station=1)])
@on_virtual_time
async def test_an_echo_the_file_does_not_speak_of_is_no_acknowledgement(driver: Driver) -> None:
    tags = writable(driver)
    dev = slave(driver, tags)
    line = plant([dev], bench=Bench(echo=True), echo_in_file=False)
    async with running(line):
        await asyncio.sleep(5)
        for tag, value in zip(tags, (1234, True), strict=True):
            done = line.submit(dev, tag, value)
            await asyncio.sleep(0.9)
            assert isinstance(done.once, WriteResult)
            assert line.now[tag].value == value
        for tag, value in zip(tags, (4321, False), strict=True):
            line.stations[0].mute = True
            lost = line.submit(dev, tag, value)
            await asyncio.sleep(1.5)
            assert isinstance(lost.once, Unclear)
            line.stations[0].mute = False
            await asyncio.sleep(70)
        assert [line.now[tag].value for tag in tags] == [1234, True]


@on_virtual_time
async def test_an_echo_the_file_does_not_speak_of_is_told_once() -> None:
    driver = ModbusRtu(station=1)
    line = plant([slave(driver, writable(driver))], bench=Bench(echo=True), echo_in_file=False)
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(60)
            line.bench.vanish()
            await asyncio.sleep(5)
            line.bench.come_back()
            await asyncio.sleep(60)
    told = [entry for entry in logs if "adapter echoes" in entry["event"]]
    assert [(entry["event"], entry["log_level"]) for entry in told] == [
        ("adapter echoes", "warning")
    ]


@on_virtual_time
async def test_where_nothing_echoes_a_write_takes_one_exchange() -> None:
    driver = ModbusRtu(station=1)
    tags = writable(driver)
    dev = slave(driver, tags, reply_timeout=2.0)
    line = plant([dev])
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(5)
            for tag, value in zip(tags, (1234, True), strict=True):
                done = line.submit(dev, tag, value)
                await asyncio.sleep(0.5)
                assert isinstance(done.once, WriteResult)
            assert not dev.record.failures
    assert not [entry for entry in logs if "echo" in entry["event"]]


@on_virtual_time
async def test_a_dead_slave_is_not_brought_to_life_by_the_echo_of_a_loopback() -> None:
    """Function 08 is answered with the request, too."""
    driver = ModbusRtu(station=1, diagnostics=True)
    dev = slave(driver, writable(driver))
    line = plant([dev], bench=Bench(echo=True), echo_in_file=False)
    line.stations[0].mute = True
    async with running(line):
        await asyncio.sleep(60)
        assert line.state(dev) is State.OFFLINE
        assert not any(alive for _, _, alive in line.lives)
        line.stations[0].mute = False
        await asyncio.sleep(70)
        assert line.state(dev) is State.ONLINE


# Several questions open at once


@dataclass
class Network(Bench):
    """A Modbus TCP device: each question has its own latency, None for one that is lost."""

    latency: Callable[[int], float | None] = lambda _: 0.02  # by the question's number, from 0
    cut_at: int = -1  # the question in whose answer the connection breaks
    numbers: list[int] = field(default_factory=list)  # transactions, as they were asked
    answered: list[int] = field(default_factory=list)
    open_now: int = 0
    open_most: int = 0
    codec: MbapCodec = field(default_factory=MbapCodec)

    async def open(self, stations: Sequence[Any], wire: WireTiming, ear: Receiver) -> "Network":
        self.opened.append(now())
        self.ear, self.codec, self.open_now = ear, MbapCodec(), 0
        self.station = stations[0]
        return self

    async def close(self) -> None:
        self.ear = None

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        for frame in self.codec.feed(data):
            number = len(self.numbers)
            self.numbers.append(frame.transaction)
            wait = self.latency(number)
            if wait is not None:
                self.open_now += 1
                self.open_most = max(self.open_most, self.open_now)
                question = MbapCodec().encode(frame)
                ear = self.ear
                asyncio.get_running_loop().call_later(wait, self._answer, number, question, ear)

    def _answer(self, number: int, question: bytes, ear: Receiver | None) -> None:
        if ear is None or ear is not self.ear:
            return
        (reply,) = self.station.hear(question, now())
        self.open_now -= 1
        self.answered.append(self.numbers[number])
        if number == self.cut_at:
            ear.received(reply[:11])
            self.ear = None
            ear.lost(LineDown("closed by the other side"))
        else:
            ear.received(reply)


def windowed(window: int, blocks: int = 8, every: float = 0.01, **timing: Any) -> Device:
    driver = ModbusTcp(window=window)
    tags = registers(driver, *[3] * blocks, every=every)  # too far apart for one question
    return slave(driver, tags, wire=NETWORK, **{"reply_timeout": 0.3, **timing})


def network(device: Device, **settings: Any) -> tuple[Plant, Network, Witness]:
    bench = Network(**settings)
    line = plant([device], wire=NETWORK, bench=bench)
    return line, bench, Witness(line)


@pytest.mark.parametrize("window", [1, 2, 4, 8])
@on_virtual_time
async def test_as_many_questions_are_open_at_once_as_the_window_says(window: int) -> None:
    """With 20 ms of latency that many times the reads are done."""
    dev = windowed(window)
    line, bench, witness = network(dev)
    async with running(line):
        await asyncio.sleep(1)
        start = good_before = dev.record.exchanges
        await asyncio.sleep(10)
    assert bench.open_most == window
    rate = (dev.record.exchanges - good_before) / 10
    assert 0.9 * window / 0.02 <= rate <= window / 0.02 + 1
    assert start > 0
    assert witness.wrong == []
    assert dev.record.turnaround == pytest.approx(0.02 / window, rel=0.2)


@on_virtual_time
async def test_answers_in_any_order_are_matched_by_their_number() -> None:
    chance = random.Random(5)
    dev = windowed(8)
    line, bench, witness = network(dev, latency=lambda _: chance.uniform(0.001, 0.1))
    async with running(line):
        await asyncio.sleep(60)
    assert bench.answered != sorted(bench.answered)
    assert witness.wrong == []
    assert witness.right > 10_000
    assert not dev.record.failures
    assert dev.record.unasked == 0


@pytest.mark.parametrize("after", [None, 0.4])
@on_virtual_time
async def test_a_question_that_times_out_does_not_spoil_those_beside_it(
    after: float | None,
) -> None:
    """Lost, or answered within the guard; the others of its round are good."""
    dev = windowed(4, blocks=4)
    lost = 42
    line, bench, witness = network(dev, latency=lambda n: after if n == lost else 0.02)
    async with running(line):
        while len(bench.numbers) <= lost:
            await asyncio.sleep(0.01)
        asked = now()
        await asyncio.sleep(0.25)  # before the time-out
        told = {s.tag.span.start // 1000 for at, s in line.told if at >= asked}
        assert len(told) == 3
        await asyncio.sleep(2)
        assert line.good(dev)
    assert dev.record.failures == {"silence": 1}
    assert dev.record.late == (0 if after is None else 1)
    assert all(s.quality is Quality.GOOD for at, s in line.told if at > 1001)
    assert witness.wrong == []


@on_virtual_time
async def test_a_connection_cut_in_mid_frame_is_opened_anew_and_half_the_frame_is_forgotten() -> (
    None
):
    dev = windowed(4, blocks=4, every=0.2)
    line, bench, witness = network(dev, cut_at=21)
    async with running(line):
        await asyncio.sleep(10)
        assert line.good(dev)
    assert len(bench.opened) == 2
    cut = line.turned(dev.tags[0], Quality.BAD, 1000.5)
    assert {s.reason for at, s in line.told if at == cut and s.quality is Quality.BAD} == {
        Reason.LINE_DOWN
    }
    assert line.turned(dev.tags[0], Quality.GOOD, cut) - cut < 0.5
    assert witness.wrong == []
    assert not dev.record.failures
