"""Several Modbus TCP requests open at once."""

import asyncio
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.errors import LineDown
from gateway.line.groups import ended
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.modbus import (
    MbapCodec,
    ModbusTcp,
)
from gateway.tags import Quality, Reason, WriteResult
from gateway.transport import Receiver
from tests.line.slaves import NETWORK, plant, registers, slave, writable
from tests.sim.bench import Bench
from tests.sim.plant import Plant, running
from tests.sim.virtual import now, on_virtual_time
from tests.sim.witness import Witness


@dataclass
class Network(Bench):
    """A Modbus TCP device with a latency for each request; None: the request is lost."""

    latency: Callable[[int], float | None] = lambda _: 0.02  # by the number of the request, from 0
    cut_at: int = -1  # the request in whose reply the connection breaks
    numbers: list[int] = field(default_factory=list)  # transactions, in the order of the requests
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
                request = MbapCodec().encode(frame)
                ear = self.ear
                asyncio.get_running_loop().call_later(wait, self._answer, number, request, ear)

    def _answer(self, number: int, request: bytes, ear: Receiver | None) -> None:
        if ear is None or ear is not self.ear:
            return
        (reply,) = self.station.hear(request, now())
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
    tags = registers(driver, *[3] * blocks, every=every)  # too far apart for one request
    return slave(driver, tags, wire=NETWORK, **{"reply_timeout": 0.3, **timing})


def network(device: Device, **settings: Any) -> tuple[Plant, Network, Witness]:
    bench = Network(**settings)
    line = plant([device], wire=NETWORK, bench=bench)
    return line, bench, Witness(line)


@pytest.mark.parametrize("window", [1, 2, 4, 8])
@on_virtual_time
async def test_the_window_is_the_number_of_open_requests(window: int) -> None:
    """With 20 ms of latency the reads multiply by the window."""
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
    assert dev.record.replies.turnaround == pytest.approx(0.02 / window, rel=0.2)


@on_virtual_time
async def test_replies_in_any_order_are_matched_by_transaction_number() -> None:
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
async def test_a_time_out_leaves_the_other_open_requests_alone(
    after: float | None,
) -> None:
    """The request is lost, or its reply comes within the guard; the others are good."""
    dev = windowed(4, blocks=4)
    lost = 42
    line, bench, witness = network(dev, latency=lambda n: after if n == lost else 0.02)
    async with running(line):
        while len(bench.numbers) <= lost:
            await asyncio.sleep(0.01)
        asked = now()
        await asyncio.sleep(0.25)  # before the time-out
        read = {s.tag.span.start // 1000 for at, s in line.reported if at >= asked}
        assert len(read) == 3
        await asyncio.sleep(2)
        assert line.good(dev)
    assert dev.record.failures == {"silence": 1}
    assert dev.record.late == (0 if after is None else 1)
    assert all(s.quality is Quality.GOOD for at, s in line.reported if at > 1001)
    assert witness.wrong == []


@on_virtual_time
async def test_a_connection_cut_in_a_frame_is_reopened_without_the_half_frame() -> None:
    dev = windowed(4, blocks=4, every=0.2)
    line, bench, witness = network(dev, cut_at=21)
    async with running(line):
        await asyncio.sleep(10)
        assert line.good(dev)
    assert len(bench.opened) == 2
    cut = line.turned(dev.tags[0], Quality.BAD, 1000.5)
    assert {s.reason for at, s in line.reported if at == cut and s.quality is Quality.BAD} == {
        Reason.LINE_DOWN
    }
    assert line.turned(dev.tags[0], Quality.GOOD, cut) - cut < 0.5
    assert witness.wrong == []
    assert not dev.record.failures


@on_virtual_time
async def test_a_late_answer_with_a_known_number_is_no_evidence_against_the_present_request() -> (
    None
):
    """The reply to request 42 arrives long after the guard, while every other request is lost."""
    dev = windowed(1, blocks=2, every=0.5, retries=9)
    first = 42
    line, bench, _ = network(
        dev, latency=lambda n: {first: 1.0}.get(n, None if n > first else 0.02)
    )
    async with running(line):
        while len(bench.numbers) <= first:
            await asyncio.sleep(0.01)
        await asyncio.sleep(2.0)
    assert dev.record.late == 1
    assert set(dev.record.failures) == {"silence"}
    assert dev.record.unasked == 0


@dataclass
class Queue(Network):
    """A bridge that passes on one request at a time. A unit that still replies misses the next one,
    and the bridge waits for it long."""

    kept: list[tuple[bytes, float]] = field(default_factory=list)

    def write(self, data: bytes) -> None:
        self.sent.append((now(), data))
        for frame in self.codec.feed(data):
            self.kept.append((MbapCodec().encode(frame), 6.0 if self.kept else 0.005))
            if len(self.kept) == 1:
                self._serve()

    def _serve(self) -> None:
        asyncio.get_running_loop().call_later(self.kept[0][1], self._served)

    def _served(self) -> None:
        (request, took), ear = self.kept.pop(0), self.ear
        assert ear is not None
        (reply,) = self.station.hear(request, now())
        if took > 1.0:
            reply = request[:4] + bytes((0, 3, request[6], request[7] | 0x80, 0x0B))
        ear.received(reply)
        if self.kept:
            self._serve()


@on_virtual_time
async def test_a_bridge_works_through_its_queue_before_it_gets_more() -> None:
    """Each probe of the device would wait behind the ones before; `hostile` seed 1800014."""
    dev = windowed(2, every=1.0)
    queue = Queue()
    line = plant([dev], wire=NETWORK, bench=queue)
    witness = Witness(line)
    async with running(line):
        await asyncio.sleep(150)  # it is back three times, and loses one of two requests again
        assert dev.one_at_a_time
        assert dev.health.online
        failures = dev.record.failures.total()
        await asyncio.sleep(60)
        assert dev.record.failures.total() == failures
    assert len(queue.kept) <= 1
    assert witness.wrong == []


@on_virtual_time
async def test_a_write_that_was_waited_for_too_long_comes_before_the_next_one() -> None:
    """Its client hears that it may yet be done; the next one ends with its own reply; `hostile`
    seed 2700022."""
    driver = ModbusTcp(window=1)
    tag, _ = writable(driver)
    dev = slave(driver, [tag], wire=NETWORK, reply_timeout=5.0)
    line, bench, _ = network(dev, latency=lambda n: 1.0 if n else 0.02)
    async with running(line):
        while not line.good(dev):
            await asyncio.sleep(0.01)
        first = await ended(line.line.write_group(dev, [(tag, [7])]), 0.1)
        begun = len(bench.answered)
        second = await ended(line.line.write_group(dev, [(tag, [8])]), 9.0)
    assert [str(end) for end in first] == ["not acknowledged within 0.1 s: it may yet be done"]
    assert isinstance(second[0], WriteResult)
    writes = [data[-1] for _, data in bench.sent if data[7] == 6]
    assert writes == [7, 8]
    assert len(bench.answered) >= begun + 2
    assert line.stations[0].inner.memory.read("holding", 5, 1, now()) == [8]
