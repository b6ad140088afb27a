"""Modbus on a line: late and silent slaves, broadcasts, exceptions, three dialects on one wire."""

import asyncio
import itertools
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from gateway.engine.device.health import State
from gateway.errors import Unclear
from gateway.protocols.modbus import (
    Frame,
    ModbusAscii,
    ModbusRtu,
    RtuSlaveCodec,
)
from gateway.stations.modbus import ModbusStation
from gateway.tags import Quality, Reason, WriteResult, WriteRule
from tests.line.slaves import plant, registers, slave
from tests.sim.bench import WIRE, Bench
from tests.sim.plant import Plant, make_tag, running
from tests.sim.virtual import now, on_virtual_time
from tests.sim.witness import Witness
from tests.vectors import vectors


def good_reads(plant: Plant, since: float = 0.0) -> int:
    return sum(len(plant.reads(device, since)) for device in plant.devices)


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("sizes", [(3, 3, 3), (2, 3, 4)])
@on_virtual_time
async def test_late_replies_never_make_a_wrong_value(
    kind: type[ModbusRtu | ModbusAscii], share: float, sizes: tuple[int, ...]
) -> None:
    """50 to 150 ms after the time-out; the four cases of a framing are 10,000 reads."""
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
async def test_four_slaves_beside_a_silent_one_keep_95_percent_of_their_reads(
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


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@on_virtual_time
async def test_a_broadcast_is_followed_by_the_turnaround_and_no_reply(
    kind: type[ModbusRtu | ModbusAscii],
) -> None:
    broadcast, slaves = kind(station=0), [kind(station=n) for n in (1, 2)]
    to_all = [
        make_tag("holding:4", broadcast, type="uint32", device="all", write=WriteRule()),
        make_tag("coil:16", broadcast, device="all", write=WriteRule()),
    ]
    devices = [slave(d, registers(d, 20, every=0.02)) for d in slaves]
    devices.append(slave(broadcast, to_all))
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


@dataclass
class Twisted:
    """A station whose replies are changed on their way out."""

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
    """Changes the replies of the station from now on."""
    station: Any = line.stations[number]
    station.inner = Twisted(station.inner, twist)
    twisted: Twisted = station.inner
    return twisted


@pytest.mark.parametrize("code", [5, 6])
@on_virtual_time
async def test_a_busy_slave_is_polled_after_a_growing_pause(code: int) -> None:
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
        assert 2.0 <= pauses[1] < 2.1
        assert line.reason(devices[0].tags[0]) is Reason.REFUSED
        assert devices[0].record.refusals[f"0{code}"] == len(busy.answered)
        assert devices[0].state is State.ONLINE
        assert len(line.reads(devices[1], start)) >= 0.95 * 60
        busy.twist = lambda pdu: pdu
        await asyncio.sleep(6)
        assert line.good(devices[0])


@on_virtual_time
async def test_exception_02_is_halved_down_to_the_missing_registers() -> None:
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
        # Each bad address was tried again after 2 s, is tried after 10 s, and not before 60 s.
        assert dev.record.refusals["02"] == settled + len(bad)


@pytest.mark.parametrize(
    ("addressing", "text", "area", "done"),
    [("vigor", "D300", "D", True), ("plain", "holding:300", "holding", False)],
)
@on_virtual_time
async def test_only_vigor_may_acknowledge_function_06_with_address_0(
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
    """Keeps the time of each received piece as well."""

    heard: list[float] = field(default_factory=list)

    def received(self, data: bytes) -> None:
        self.heard.append(now())
        super().received(data)


@on_virtual_time
async def test_three_dialects_share_one_line_and_ex485lnk_gets_its_silence() -> None:
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
