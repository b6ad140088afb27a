"""Links that stall and then deliver all replies at once, or that are never quiet."""

import asyncio
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import pytest

from gateway.engine.device.health import State
from gateway.errors import Busy, LineDown
from gateway.protocols.checksums import crc16
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.simulator.plant import station_for
from gateway.tags import Quality, Reason, Tag, WriteResult, WriteRule
from tests.line.device_server import GUARD, DeviceServer, behind
from tests.sim.bench import WIRE
from tests.sim.plant import Outcome, Plant, made_device, make_tag, running
from tests.sim.virtual import now, on_virtual_time


@pytest.mark.parametrize("stall", [20.0, 90.0, 400.0])
@pytest.mark.parametrize("sizes", [(20, 1), (9, 20), (18, 9, 3)])
@pytest.mark.parametrize("driver", [ModbusRtu(station=1), ModbusAscii(station=1), Vigor(station=1)])
@on_virtual_time
async def test_a_link_that_kept_more_requests_than_can_be_told_apart(
    driver: AnyDriver, sizes: tuple[int, ...], stall: float
) -> None:
    """The proof has a shape of its own, which a poll may have, too."""
    area = "D" if driver.protocol == "vigor" else "holding:"
    numbers = [1000 * n + i for n, size in enumerate(sizes) for i in range(size)]
    tags = [make_tag(f"{area}{n}", driver, device="plc", type="uint16") for n in numbers]
    server = DeviceServer()
    line, dev, memory = behind(server, driver, *tags)
    for number in numbers:
        memory.write(area.strip(":"), number, [number])
    async with running(line):
        for phase in range(6):
            await asyncio.sleep(20 + phase * 0.37)
            assert dev.state is State.ONLINE
            server.flows.clear()
            await asyncio.sleep(stall)
            server.flows.set()
        await asyncio.sleep(20)
        assert line.good(dev)
    assert wrong_values(line) == []


def wrong_values(line: Plant) -> list[object]:
    """The wrong good values, where each word holds its own number."""
    good = (sample for _, sample in line.reported if sample.quality is Quality.GOOD)
    return [(s.tag.text, s.value) for s in good if s.value != s.tag.address.number]


@pytest.mark.parametrize(
    ("retries", "stall"), [(2, 6.0), (2, 12.0), (2, 30.0), (4, 4.0), (6, 5.0), (10, 8.0)]
)
@pytest.mark.parametrize("expedited", [True, False])
@pytest.mark.parametrize("driver", [ModbusRtu(station=1), ModbusAscii(station=1), Vigor(station=1)])
@on_virtual_time
async def test_after_a_stall_no_old_reply_is_taken_for_a_new_one(
    driver: AnyDriver, expedited: bool, retries: int, stall: float
) -> None:
    """No request is lost: the replies to all of them arrive one after the other."""
    area = "D" if driver.protocol == "vigor" else "holding:"
    numbers = (100, 1000, 1001, 2000, 2001, 2002, 3000, 3001, 3002, 3003)
    tags = [make_tag(f"{area}{n}", driver, device="plc", type="uint16") for n in numbers]
    server = DeviceServer()
    line, dev, memory = behind(server, driver, *tags, retries=retries)
    for number in range(4000):
        memory.write(area.strip(":"), number, [number])
    async with running(line):
        for phase in range(10):
            await asyncio.sleep(20 + phase * 0.11)
            assert dev.state is State.ONLINE
            server.flows.clear()
            end = now() + stall
            while now() < end:
                await asyncio.sleep(1.0)
                if expedited:
                    line.line.expedite(dev, tags[0])
            server.flows.set()
        await asyncio.sleep(20)
        assert line.good(dev)
    assert wrong_values(line) == []


@on_virtual_time
async def test_after_a_stall_a_bit_write_keeps_the_other_bits_of_the_word() -> None:
    driver = ModbusRtu(station=1)
    bit = make_tag("holding:500.3", driver, device="plc", write=WriteRule(verify=True))
    words = [
        make_tag(f"holding:{n}", driver, device="plc", type="uint16") for n in (100, 1000, 1001)
    ]
    server = DeviceServer()
    line, dev, memory = behind(server, driver, *words, bit)
    memory.write("holding", 500, [0xA5A0])
    async with running(line):
        for phase in range(20):
            await asyncio.sleep(20 + phase * 0.055)
            server.flows.clear()
            asyncio.get_running_loop().call_later(8.0, server.flows.set)
            outcomes = []
            for value in (True, False) * 12:
                await asyncio.sleep(1.0)
                outcomes.append(line.submit(dev, bit, value))
            await asyncio.sleep(6.0)
            assert sum(isinstance(outcome.once, WriteResult) for outcome in outcomes) > 4
            assert memory.read("holding", 500)[0] in (0xA5A0, 0xA5A8)


@dataclass
class FewRegisters:
    """A Modbus RTU slave with these holding registers and no others."""

    held: dict[int, int]
    inner: Any

    def hear(self, data: bytes, at: float) -> list[bytes]:
        first, count = int.from_bytes(data[2:4], "big"), int.from_bytes(data[4:6], "big")
        if all(number in self.held for number in range(first, first + count)):
            return list(self.inner.hear(data, at))
        refusal = bytes((data[0], data[1] | 0x80, 2))
        return [refusal + crc16(refusal)]


@pytest.mark.parametrize("longest", [2.0, 3.0])
@on_virtual_time
async def test_late_refusals_acknowledge_no_write(
    longest: float,
) -> None:
    """An exception names no request: those to our own probes come late, too."""
    driver = ModbusRtu(station=1, write_single=False)
    numbers = (100, 101, 200, 201, 300)
    rule = WriteRule()
    tags = [
        make_tag(f"holding:{n}", driver, device="plc", type="uint16", write=rule) for n in numbers
    ]
    server = DeviceServer(
        late=lambda chance: chance.uniform(0, longest) if chance.random() < 0.3 else 0.0, seed=3
    )
    dev = made_device("plc", driver, WIRE, driver.timing, tuple(tags), GUARD)
    inner = station_for(driver, [])
    held: dict[int, set[int]] = {number: {number} for number in numbers}  # ever
    for number in numbers:
        inner.memory.write("holding", number, [number])
    line = Plant([dev], [FewRegisters(dict.fromkeys(numbers, 0), inner)], server, WIRE)  # type: ignore[list-item]
    false: list[object] = []

    def judged(tag: Tag, value: int, written: asyncio.Future[WriteResult]) -> None:
        there = inner.memory.read("holding", tag.address.number)[0]
        if written.exception() is None and there != value:
            false.append((tag.text, value, there))

    async with running(line):
        for count in range(1500):
            tag, value = tags[count % 5], 1000 + count
            held[tag.address.number].add(value)
            written = line.line.write(dev, tag, [value])
            written.add_done_callback(partial(judged, tag, value))
            await asyncio.sleep(0.7)
    assert false == []
    good = [s for _, s in line.reported if s.quality is Quality.GOOD]
    assert len(good) > 150  # late replies are extra ones: each read has a proof
    assert all(sample.value in held[sample.tag.address.number] for sample in good)


@pytest.mark.parametrize(
    ("driver", "address"),
    [
        (Vigor(station=1), "D100"),
        (ComputerLink(station=1), "D100"),
        (ModbusRtu(station=1), "holding:100"),
        (ModbusAscii(station=1), "holding:100"),
    ],
)
@on_virtual_time
async def test_on_a_line_that_is_never_quiet_values_turn_bad_and_writes_end(
    driver: AnyDriver, address: str
) -> None:
    """A stuck transceiver, or another master."""
    tag = make_tag(address, driver, device="plc", write=WriteRule())
    server = DeviceServer()
    line, dev, _ = behind(server, driver, tag)

    async def babble() -> None:
        while True:
            server.received(b"\x00")
            await asyncio.sleep(0.001)

    async with running(line):
        await asyncio.sleep(5)
        assert line.good(dev)
        noise = asyncio.create_task(babble())
        await asyncio.sleep(0.01)
        first = line.submit(dev, tag, 7)
        began = now()
        await asyncio.sleep(30)
        assert isinstance(first.once, Busy)
        assert "never quiet" in str(first.once)
        assert line.now[tag].quality is Quality.BAD
        assert line.turned(tag, Quality.BAD, began) - began < 2 * tag.every + 2.0
        assert not [data for at, data in server.sent if at > began]
        assert "baud rate" in dev.diagnosis()
        noise.cancel()
        await asyncio.sleep(90)
        assert line.good(dev)
        second = line.submit(dev, tag, 8)
        await asyncio.sleep(1)
        assert isinstance(second.once, WriteResult)


@pytest.mark.parametrize("delay", [0.005, 0.04, 0.08])
@on_virtual_time
async def test_the_echo_of_our_own_area_c_acknowledges_no_write(delay: float) -> None:
    """The file does not say that the adapter echoes; every write is lost on the wire."""
    driver = ComputerLink(station=5, send_area_c=True)
    tag = make_tag("D100", driver, device="plc", every=0.1, write=WriteRule())
    server = DeviceServer(echo=True, latency=delay)
    line, dev, _ = behind(server, driver, tag, echo_in_file=False)
    async with running(line):
        await asyncio.sleep(3)
        server.deaf_to = lambda request: request[5:7] == b"WW"
        outcomes = list[Outcome]()
        for value in range(10):
            outcomes.append(line.submit(dev, tag, value))
            await asyncio.sleep(7)
    assert not any(isinstance(outcome.once, WriteResult) for outcome in outcomes)


@on_virtual_time
async def test_a_write_behind_a_long_transaction_ends_at_its_expiry() -> None:
    """It does not wait for the end of the transaction before it."""
    driver = Vigor(station=1)
    tags = [make_tag(f"D{n}", driver, device="plc", write=WriteRule()) for n in (100, 1000)]
    server = DeviceServer()
    slow = replace(driver.timing, reply_timeout=15.0)
    dev = made_device("plc", driver, WIRE, slow, tuple(tags), GUARD)
    line = Plant([dev], [station_for(driver, [])], server, WIRE)  # type: ignore[list-item]
    async with running(line):
        await asyncio.sleep(5)
        server.flows.clear()
        await asyncio.sleep(2)  # a poll is on its way now
        outcome = line.submit(dev, tags[0], 5)
        await asyncio.sleep(6)
        assert isinstance(outcome.once, Busy)
        assert outcome.at - outcome.asked == pytest.approx(5.0, abs=0.01)


@on_virtual_time
async def test_no_device_is_online_on_a_lost_line() -> None:
    driver = Vigor(station=1)
    server = DeviceServer()
    tag = make_tag("D100", driver, device="plc")
    line, dev, _ = behind(server, driver, tag)
    async with running(line):
        await asyncio.sleep(5)
        assert line.state(dev) is State.ONLINE
        assert server.ear is not None
        server.ear.lost(LineDown("pulled out"))
        await asyncio.sleep(0.01)
        assert line.state(dev) is State.STARTING
        assert dev.diagnosis() == "pulled out"
        assert line.reason(tag) is Reason.LINE_DOWN
        await asyncio.sleep(5)
        assert line.state(dev) is State.ONLINE
        assert dev.diagnosis() == ""


@pytest.mark.parametrize("reply_timeout", [0.5, 5.0])
@on_virtual_time
async def test_port_loss_while_the_line_settles_is_reported_at_once(
    reply_timeout: float,
) -> None:
    driver = ModbusRtu(station=1)
    tag = make_tag("holding:100", driver, device="plc", every=0.2)
    server = DeviceServer()
    line, dev, _ = behind(server, driver, tag, reply_timeout=reply_timeout, retries=10)
    async with running(line):
        await asyncio.sleep(5)
        server.flows.clear()
        await asyncio.sleep(3 * dev.longest_reply)
        asked = len(server.sent)
        server.flows.set()
        await asyncio.sleep(0.4)
        assert len(server.sent) <= asked + 1  # it settles
        assert server.ear is not None
        gone = now()
        server.ear.lost(LineDown("pulled out"))
        await asyncio.sleep(0.01)
        at, name, online = line.online_changes[-1]
        assert (name, online) == ("plc", False)
        assert at == pytest.approx(gone, abs=0.01)


@on_virtual_time
async def test_writes_refused_together_end_at_their_expiry() -> None:
    """They return to the queue one by one, after the timer found it empty."""
    driver = ComputerLink(station=1)
    tags = [make_tag(f"D{n}", driver, device="plc", write=WriteRule()) for n in (100, 200, 300)]
    server = DeviceServer()
    line, dev, _ = behind(server, driver, *tags, reply_timeout=15.0)
    refuse = b"\x1501FF03"  # a code that says nothing was done
    hear = line.stations[0].hear

    def refusing(data: bytes, now: float) -> list[bytes]:
        return [refuse] if data[5:7] == b"WT" else hear(data, now)

    line.stations[0].hear = refusing  # type: ignore[method-assign]  # no `Unruly` here
    async with running(line):
        await asyncio.sleep(5)
        line.submit(dev, tags[2], 7)  # arms the timer, and is done
        await asyncio.sleep(4.98)
        outcomes = [line.submit(dev, tag, n) for n, tag in enumerate(tags[:2])]
        server.deaf_to = lambda request: request[5:7] == b"WW"  # sent one by one they are lost
        await asyncio.sleep(20.0)
        late = outcomes[1]
        assert "NAK 03" in str(late.once)  # it was sent once
        assert str(late.once).endswith("waited 5.0 s for the line; not sent")
        assert late.at - late.asked < 6.0
