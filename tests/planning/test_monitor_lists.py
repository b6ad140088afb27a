"""Monitor lists: chosen if they cost less, registered again after every fault."""

import asyncio
import random
from collections.abc import Callable
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.planning.monitor_lists import with_monitor_list
from gateway.planning.planner import Block
from gateway.protocols.computer_link import ComputerLink, Enquiry, LinkCodec, Nak
from gateway.protocols.vigor import Vigor
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.computer_link.devices import Cells, Kind
from gateway.tags import Quality, Reason
from tests.sim.links import commands, link_device, link_plant, spelt
from tests.sim.plant import Plant, clockwork, running
from tests.sim.virtual import on_virtual_time
from tests.sim.witness import Witness

SCATTERED = [f"D{n}" for n in range(0, 3000, 400)]
POINTS = [f"M{n}" for n in range(0, 1000, 100)]


def now() -> float:
    return asyncio.get_running_loop().time()


def one(*addresses: str, every: float = 0.5, **settings: Any) -> tuple[Plant, Device]:
    driver = ComputerLink(station=5, monitor=settings.pop("monitor", True))
    dev = link_device(driver, *addresses, every=every, **settings)
    return link_plant([dev]), dev


def listed(dev: Device) -> list[Block]:
    return [block for block in dev.blocks if block.listed]


# Chosen


@pytest.mark.parametrize("addresses", [SCATTERED, POINTS], ids=["words", "points"])
def test_scattered_addresses_are_read_by_a_list(addresses: list[str]) -> None:
    _, dev = one(*addresses)
    [block] = dev.blocks
    assert len(block.listed) == len(addresses)
    assert {tag.text for tag in block.tags} == set(addresses)


@pytest.mark.parametrize(
    ("addresses", "settings"),
    [
        ([f"D{n}" for n in range(40)], {}),  # neighbours
        (["D0"], {}),  # one: a list saves no transaction
        (["C200", "C240"], {}),  # 32 bits: MN cannot
        (SCATTERED, {"monitor": False}),
    ],
    ids=["neighbours", "a single one", "32 bits", "disabled"],
)
def test_no_list_if_it_saves_nothing_or_is_disabled(
    addresses: list[str], settings: dict[str, Any]
) -> None:
    _, dev = one(*addresses, **settings)
    assert listed(dev) == []


def test_a_list_never_costs_more_and_every_tag_is_read_once() -> None:
    chance = random.Random(7)
    chosen = 0
    for _ in range(60):
        numbers = chance.sample(range(3999), chance.randint(1, 30))
        texts = [chance.choice(["D", "D", "M", "S", "TN"]) + f"{n % 250}" for n in numbers]
        addresses = list(dict.fromkeys(texts))
        _, with_lists = one(*addresses)
        _, without = one(*addresses, monitor=False)
        assert with_lists.load <= without.load * (1 + 1e-9)
        read = [tag.text for block in with_lists.blocks for tag in block.tags]
        assert sorted(read) == sorted(addresses)
        chosen += bool(listed(with_lists))
        for block in listed(with_lists):
            assert len(block.listed) <= 10
    assert chosen > 20


def test_refused_addresses_are_in_no_list() -> None:
    _, dev = one(*SCATTERED)
    dev.monitor.refused(0.0)
    dev.plan()
    bad = next(block for block in dev.blocks if block.tags[0].text == "D800")
    dev.bad_addresses.refused(bad, 0, "06")
    dev.monitor.allow()
    dev.plan()
    [block] = listed(dev)
    assert {tag.text for tag in block.tags} == set(SCATTERED) - {"D800"}
    assert bad.span in {other.span for other in dev.blocks if not other.listed}


def test_a_driver_without_lists_keeps_its_plan() -> None:
    _, dev = one(*SCATTERED, monitor=False)
    assert with_monitor_list(dev.blocks, Vigor(station=1), dev.seconds) == dev.blocks


# Registered, read, and registered again


@on_virtual_time
async def test_a_list_is_registered_once_and_then_read() -> None:
    line, dev = one(*SCATTERED, *POINTS[:3])
    station = line.stations[0]
    for n, text in enumerate(SCATTERED):
        station.memory.write("D", int(text[1:]), [100 + n])
    station.memory.write("M", 100, [1])
    async with running(line):
        await asyncio.sleep(10)
        assert line.good(dev)
        values = {tag.text: line.now[tag].value for tag in dev.tags}
        assert values == {text: 100 + n for n, text in enumerate(SCATTERED)} | {
            "M0": False,
            "M100": True,
            "M200": False,
        }
        sent = commands(station)
        assert sent.count("WM") == 1
        assert sent.count("MN") >= 18


async def _lost(line: Plant) -> None:
    _link_station(line).link.forget_monitor()


async def _power_cycle(line: Plant) -> None:
    line.stations[0].mute = True
    _link_station(line).power_cycle()
    await asyncio.sleep(0.7)
    line.stations[0].mute = False


async def _timed_out(line: Plant) -> None:
    station = line.stations[0]
    station.late = lambda _: 0.4
    while not line.devices[0].health.consecutive_failures:
        await asyncio.sleep(0.01)
    station.late = lambda _: 0.0


async def _line_lost(line: Plant) -> None:
    """Another computer uses the port meanwhile and leaves a list of the same length."""
    line.bench.vanish()
    _other_list(line)
    await asyncio.sleep(1)
    line.bench.come_back()


async def _other_computer(line: Plant) -> None:
    """Another computer on the wire registers a list of the same length; the line receives it."""
    _other_list(line)
    line.bench.received(_registration())


def _registration() -> bytes:
    cells = "".join(f"D{3900 + n:04d}" for n in range(len(SCATTERED)))
    return LinkCodec().encode(Enquiry(5, "WM", f"{len(SCATTERED):02X}{cells}"))


def _other_list(line: Plant) -> None:
    # Private: a frame of another computer would also reach the line under test.
    _link_station(line).link._lists["WM"] = [
        Cells("D", 3900 + i, 1, Kind.WORDS) for i in range(len(SCATTERED))
    ]


def _link_station(line: Plant) -> ComputerLinkStation:
    station: object = line.stations[0].inner
    assert isinstance(station, ComputerLinkStation)
    return station


def _intercept(line: Plant, reply: Callable[[str], object]) -> None:
    """Lets `reply` answer; for NotImplemented the station itself answers."""
    station: Any = _link_station(line)
    # Private: no setting of the station refuses or loses single commands.
    answer = station._answer

    def intercepted(text: str) -> object:
        found = reply(text)
        return answer(text) if found is NotImplemented else found

    station._answer = intercepted


FAULTS = [_lost, _power_cycle, _timed_out, _line_lost, _other_computer]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__[1:])
@on_virtual_time
async def test_after_every_fault_the_list_is_registered_again(fault: Any) -> None:
    line, dev = one(*SCATTERED)
    station = line.stations[0]
    clockwork(station.memory, [int(text[1:]) for text in SCATTERED])
    station.memory.write("D", 3900, [7777] * len(SCATTERED))
    async with running(line):
        await asyncio.sleep(5)
        assert commands(station).count("WM") == 1
        since = now()
        await fault(line)
        await asyncio.sleep(10)
        assert line.good(dev)
        assert listed(dev)
        dev.plan()
        assert listed(dev)  # lists are still allowed
        again = commands(station, since)
        assert again.count("WM") == 1
        assert again[-1] == "MN"
        published = [sample for at, sample in line.reported if at >= since]
        assert 7777 not in {sample.value for sample in published}
        assert not [s for s in published if s.reason is Reason.REFUSED]


@on_virtual_time
async def test_a_registration_without_an_acknowledgement_is_repeated() -> None:
    """The PLC still holds another list of the same length."""
    line, dev = one(*SCATTERED)
    station = line.stations[0]
    clockwork(station.memory, [int(text[1:]) for text in SCATTERED])
    station.memory.write("D", 3900, [7777] * len(SCATTERED))
    _other_list(line)
    lost = [None, None]
    _intercept(line, lambda text: lost.pop() if text[4:6] == "WM" and lost else NotImplemented)
    async with running(line):
        await asyncio.sleep(20)
        assert line.good(dev)
        assert commands(station).count("WM") == 3
        assert 7777 not in {sample.value for _, sample in line.reported}


@pytest.mark.parametrize(("acknowledged", "registered"), [(b"", 2), (b"\x0605FF", 1)])
@on_virtual_time
async def test_a_list_that_is_changed_while_another_station_is_read_is_not_read(
    acknowledged: bytes, registered: int
) -> None:
    """An acknowledgement that nobody asked for ends lists for ten minutes."""
    dev = link_device(ComputerLink(station=5, monitor=True), *SCATTERED, every=0.5)
    line = link_plant([dev, link_device(ComputerLink(station=6), "D0", every=0.5)])
    first, second = line.stations
    clockwork(first.memory, [int(text[1:]) for text in SCATTERED])
    first.memory.write("D", 3900, [7777] * len(SCATTERED))
    strange: list[bytes] = []

    def answer(data: bytes, now: float) -> list[bytes]:
        replies = second.inner.hear(data, now)
        if replies and strange:
            _other_list(line)
            return [strange.pop(), *replies]
        return replies

    second.answer = answer
    async with running(line):
        await asyncio.sleep(5)
        strange.append(_registration() + acknowledged)
        await asyncio.sleep(5)
        assert strange == []
        assert line.good(dev)
        assert commands(first).count("WM") == registered
        assert 7777 not in {sample.value for _, sample in line.reported}


# Falling back


@on_virtual_time
async def test_a_bad_address_is_found_and_the_others_are_listed_again() -> None:
    line, dev = one(*SCATTERED)
    station = line.stations[0]
    station.inner.memory.holes = {("D", 800)}
    start = now()
    async with running(line):
        await asyncio.sleep(10)
        for tag in dev.tags:
            if tag.text == "D800":
                assert line.reason(tag) is Reason.REFUSED
            else:
                assert line.turned(tag, Quality.GOOD, start) - start < 3
                assert line.now[tag].quality is Quality.GOOD
        [block] = listed(dev)
        assert spelt(dev, "D800") not in block.tags
        assert set(commands(station, now() - 3)) == {"MN"}
        station.inner.memory.holes = set()
        await asyncio.sleep(310)
        assert line.good(dev)
        assert len(listed(dev)[0].tags) == len(SCATTERED)


@on_virtual_time
async def test_a_plc_without_these_commands_is_read_without_lists() -> None:
    line, dev = one(*SCATTERED)
    station = line.stations[0]
    refused = Nak(5, "03")
    _intercept(line, lambda text: refused if text[4:6] == "WM" else NotImplemented)
    async with running(line):
        await asyncio.sleep(10)
        assert line.good(dev)
        assert listed(dev) == []
        assert commands(station).count("WM") == 2
        assert set(commands(station, now() - 3)) == {"WR"}


@on_virtual_time
async def test_a_change_of_blocks_keeps_the_age_of_the_values() -> None:
    """Old values become bad also when the device fails before the first read of the new blocks."""
    line, dev = one(*SCATTERED, every=2.0, reply_timeout=1.0, guard=1.0, retries=20)
    async with running(line):
        await asyncio.sleep(5)
        assert line.good(dev)
        for lists in (True, False):
            dev.monitor.allowed = lists
            dev.plan()
            line.line.engine.schedule.plan(dev, now())
        line.stations[0].mute = True
        await asyncio.sleep(8)
        assert {line.now[tag].quality for tag in dev.tags} == {Quality.BAD}


# All faults at once


@pytest.mark.parametrize("seed", [1, 3, 9])
@on_virtual_time
async def test_no_fault_of_the_list_gives_a_wrong_good_value(seed: int) -> None:
    line, dev = one(*SCATTERED, every=0.2, type="uint16", guard=0.3)
    station = line.stations[0]
    clockwork(station.memory, [int(text[1:]) for text in SCATTERED])
    station.memory.write("D", 3900, [7777] * len(SCATTERED))
    station.late = lambda chance: 0.3 + chance.uniform(0.05, 0.6) if chance.random() < 0.1 else 0.0
    station.lose = 0.05
    chance, witness = random.Random(seed), Witness(line)
    async with running(line):
        for _ in range(150):
            await asyncio.sleep(chance.uniform(0.1, 6))
            await chance.choice([_lost, _power_cycle, _line_lost, _other_computer])(line)
        station.late, station.lose = (lambda _: 0.0), 0.0
        await asyncio.sleep(60)
        before = witness.right
        await asyncio.sleep(60)
        assert witness.right - before > 200
    assert witness.wrong == []
    assert not any("internal error" in sample.detail for _, sample in line.reported)
    assert witness.right > 2000
    assert commands(station).count("WM") > 50
    assert dev.record.late > 10
