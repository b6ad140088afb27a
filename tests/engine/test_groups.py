"""Several tags written at once, on simulated wires: one request for a run, in their order."""

import asyncio
import random
from collections.abc import Iterable, Sequence
from typing import Any

import pytest

from gateway.engine.device.device import Device
from gateway.engine.jobs.request_queue import MOST_WAITING
from gateway.engine.jobs.requests import Group, Write
from gateway.errors import Busy, NotSent, Refused, Unclear
from gateway.protocols.checksums import crc16
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.modbus import ModbusRtu
from gateway.tags import Tag, WriteResult, WriteRule
from gateway.values import Value
from tests.engine.misbehaving import intercept
from tests.engine.rig import Rig
from tests.line.slaves import plant as slaves
from tests.line.slaves import slave
from tests.sim.links import commands, link_device, link_plant, spelt
from tests.sim.plant import Outcome, Plant, device, make_tag, plant, running
from tests.sim.virtual import now, on_virtual_time

RULE, VERIFY, REPEAT = WriteRule(), WriteRule(verify=True), WriteRule(repeat=True)
SLOW: dict[str, Any] = {"every": 60.0}
RUN = ("D0", "D1", "D2")
Values = Sequence[tuple[str, Value]]


def vigor(*texts: str, write: WriteRule = RULE) -> tuple[Plant, Device]:
    made = device([make_tag(text, write=write, **SLOW) for text in texts])
    return plant([made]), made


def modbus(*texts: str, write: WriteRule = RULE, **settings: Any) -> tuple[Plant, Device]:
    driver = ModbusRtu(station=1, **settings)
    made = slave(driver, [make_tag(text, driver, write=write, **SLOW) for text in texts])
    return slaves([made]), made


def link(*texts: str, write: WriteRule = RULE) -> tuple[Plant, Device]:
    made = link_device(ComputerLink(station=5), *texts, write=write, every=60.0)
    return link_plant([made]), made


def submit(line: Plant, dev: Device, values: Values) -> list[Outcome]:
    tags = [(spelt(dev, text), value) for text, value in values]
    ends = line.line.write_group(dev, [(tag, tag.encode(value)) for tag, value in tags])
    return [Outcome(now()).of(end) for end in ends]


def sent(line: Plant, since: float) -> list[bytes]:
    return [data for at, data in line.bench.sent if at >= since]


def writes(line: Plant, since: float) -> list[bytes]:
    """The frames that write, of Vigor or Modbus RTU."""
    protocol = line.devices[0].driver.protocol
    if protocol == "vigor":
        return [data for data in sent(line, since) if data[3:5] in (b"61", b"70", b"71")]
    return [data for data in sent(line, since) if data[1] in (5, 6, 15, 16)]


def values_of(outcomes: Sequence[Outcome]) -> list[Value | str]:
    found = [outcome.once for outcome in outcomes]
    return [one.value if isinstance(one, WriteResult) else type(one).__name__ for one in found]


def held(line: Plant, tag: Tag) -> Value | None:
    return tag.decode(line.stations[0].memory.read(tag.span.area, tag.span.start, tag.span.size))


RECIPES: dict[str, tuple[Any, list[str]]] = {
    "vigor": (vigor, [f"D{n}" for n in range(100, 150)]),
    "modbus": (modbus, [f"holding:{n}" for n in range(100, 150)]),
    "modbus bits": (modbus, [f"coil:{n}" for n in range(30, 80)]),
    "computer link": (link, [f"D{n}" for n in range(100, 150)]),
    "computer link bits": (link, [f"M{n}" for n in range(3, 53)]),
    "vigor bits": (vigor, [f"M{n}" for n in range(16, 64)]),
}


@pytest.mark.parametrize("name", RECIPES)
@pytest.mark.parametrize("rule", [RULE, VERIFY], ids=["plain", "verify"])
@on_virtual_time
async def test_a_recipe_is_one_exchange_whatever_its_order(name: str, rule: WriteRule) -> None:
    kind, texts = RECIPES[name]
    line, dev = kind(*texts, write=rule)
    async with running(line):
        await asyncio.sleep(5)
        asked, chance = now(), random.Random(name)
        order = chance.sample(texts, len(texts))
        bits = name.endswith("bits")
        values = [
            (text, chance.random() < 0.5 if bits else chance.randrange(9999)) for text in order
        ]
        outcomes = submit(line, dev, values)
        await asyncio.sleep(0.4)
        assert values_of(outcomes) == [value for _, value in values]
        assert all(held(line, spelt(dev, text)) == value for text, value in values)
        assert all(outcome.once.verified is rule.verify for outcome in outcomes)
        if name.startswith("computer"):
            asked_for = commands(line.stations[0], asked)
            assert [one for one in asked_for if one[0] in "BW" and one[1] in "WT"] == [
                "BW" if bits else "WW"
            ]
        else:
            assert len(writes(line, asked)) == 1
        # The write, what reads it back, and the poll that follows it.
        assert len(sent(line, asked)) <= 2 + rule.verify
        assert dev.record.writes == len(texts)


@on_virtual_time
async def test_a_gap_takes_another_request_and_the_order_is_kept() -> None:
    """D9 would close the gap, but D50 is to be written before it."""
    line, dev = vigor("D7", "D8", "D9", "D50")
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, dev, [("D8", 8), ("D7", 7), ("D50", 50), ("D9", 9)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [8, 7, 50, 9]
        starts = [data[5:11] for data in writes(line, asked)]
        assert starts == [b"1C0E04", b"1C6402", b"1C1202"]  # D7 and D8, D50, D9


@on_virtual_time
async def test_bits_and_bytes_of_words_change_in_one_read_and_one_write() -> None:
    line, dev = vigor("D7.3", "D7.0", "D8.15", "D9", "D6")
    line.stations[0].memory.write("D", 6, [0x1111, 0b1001, 0x00F0, 0x3333])
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        values: Values = [("D7.3", False), ("D8.15", True), ("D9", 9), ("D7.0", True)]
        outcomes = submit(line, dev, values)
        await asyncio.sleep(0.06)
        assert values_of(outcomes) == [False, True, 9, True]
        assert [data[3:5] for data in sent(line, asked)][:2] == [b"51", b"61"]
        assert len(writes(line, asked)) == 1
        assert line.stations[0].memory.read("D", 6, 4) == [0x1111, 0b0001, 0x80F0, 9]


@on_virtual_time
async def test_bits_whose_words_are_refused_before_the_write_are_written_one_by_one() -> None:
    """Nothing was written: so the first is done, and the second alone is refused."""
    line, dev = vigor("D7.3", "D8.2", "D9.1")
    async with running(line):
        await asyncio.sleep(3)
        line.stations[0].inner.memory.holes = {("D", 8)}
        outcomes = submit(line, dev, [("D7.3", True), ("D8.2", True), ("D9.1", True)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [True, "Refused", "NotSent"]
        assert line.stations[0].memory.read("D", 7, 1) == [8]


@on_virtual_time
async def test_a_word_and_its_bit_are_two_requests_in_their_order() -> None:
    line, dev = vigor("D7", "D7.3", "D8")
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, dev, [("D7.3", True), ("D7", 16), ("D8", 5)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [True, 16, 5]
        assert [data[5:11] for data in writes(line, asked)] == [b"1C0E02", b"1C0E04"]
        assert line.stations[0].memory.read("D", 7, 2) == [16, 5]


@on_virtual_time
async def test_a_run_of_vigor_bits_never_writes_the_bits_around_it() -> None:
    """M0 to M7 fill a byte. M8 and M9 would take M10 to M15 with them: they are forced."""
    texts = [f"M{n}" for n in range(10)]
    line, dev = vigor(*texts)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, dev, [(text, True) for text in texts])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [True] * 10
        assert [data[3:5] for data in writes(line, asked)] == [b"61", b"70", b"70"]


@on_virtual_time
async def test_only_the_tag_that_the_device_holds_otherwise_differs() -> None:
    line, dev = vigor("D0", "D1", "D2", "D40", write=VERIFY)
    station = line.stations[0]
    write = station.memory.write

    def but_one(area: str, start: int, values: Iterable[int]) -> None:
        write(area, start, values)
        write(area, 1, [99])

    async with running(line):
        await asyncio.sleep(3)
        station.memory.write = but_one  # type: ignore[method-assign]  # a program sets D1
        outcomes = submit(line, dev, [("D0", 5), ("D1", 6), ("D2", 7), ("D40", 8)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [5, "Differs", 7, "NotSent"]
        assert str(outcomes[3].once) == "not sent, because D1 before it failed"


@on_virtual_time
async def test_a_run_to_all_stations_is_one_broadcast_without_an_acknowledgement() -> None:
    driver = ModbusRtu(station=0)
    texts = ["holding:1", "holding:2", "holding:3"]
    tags = [make_tag(text, driver, write=RULE, **SLOW) for text in texts]
    everyone, one = slave(driver, tags), slave(ModbusRtu(station=1), [])
    line = slaves([everyone, one])
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, everyone, [("holding:2", 2), ("holding:1", 1), ("holding:3", 3)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [2, 1, 3]
        assert not any(outcome.once.acknowledged for outcome in outcomes)
        assert [data[1] for data in writes(line, asked)] == [16]
        assert line.stations[1].memory.read("holding", 1, 3) == [1, 2, 3]


# After the first that is not done


@pytest.mark.parametrize("fault", ["refused", "silent"])
@on_virtual_time
async def test_after_the_first_that_is_not_done_nothing_of_the_group_is_sent(fault: str) -> None:
    """The last one is the bit that starts the machine."""
    line, dev = vigor("D0", "D20", "D40", "M0")
    station = line.stations[0]
    if fault == "refused":
        station.inner.memory.holes = {("D", 20)}
    else:
        intercept(station, lambda data: [] if data[3:9] == b"611C28" else None)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        alone = line.submit(dev, spelt(dev, "D40"), 40)  # of another client
        outcomes = submit(line, dev, [("D0", 1), ("D20", 2), ("D40", 3), ("M0", True)])
        await asyncio.sleep(6)
        done = writes(line, asked)
        first, second, *rest = outcomes
        assert isinstance(alone.once, WriteResult)
        assert isinstance(first.once, WriteResult)
        assert isinstance(second.once, Refused if fault == "refused" else Unclear)
        for other in rest:
            assert isinstance(other.once, NotSent)
            assert str(other.once) == "not sent, because D20 before it failed"
        assert [data[5:9] for data in done] == [b"1C50", b"1C00", b"1C28"]
        assert station.memory.read("M", 0) == [0]
        assert station.memory.read("D", 40) == [40]


def test_a_group_without_room_is_refused_whole() -> None:
    rig = Rig()
    rig.engine.schedule.requests.waiting.extend([rig.write("D0")] * (MOST_WAITING - 2))
    group = Group()
    tags = [spelt(rig.device, text) for text in ("D1", "D2")]
    writes = [Write(rig.device, tag, tag.encode(7), rig.now, group=group) for tag in tags]
    rig.note(rig.engine.submit_group(writes, rig.now))
    assert [type(rig.outcomes[write]) for write in writes] == [Busy, Busy]


@on_virtual_time
async def test_writes_of_two_clients_share_no_request() -> None:
    """A value of one that the device refuses must not leave the other in doubt."""
    line, dev = modbus("holding:1", "holding:2", "holding:3")
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        first = submit(line, dev, [("holding:1", 1), ("holding:2", 2)])
        second = submit(line, dev, [("holding:3", 3)])
        await asyncio.sleep(1)
        assert values_of([*first, *second]) == [1, 2, 3]
        assert [data[1] for data in writes(line, asked)] == [16, 6]


@on_virtual_time
async def test_a_tag_that_may_be_repeated_has_a_request_of_its_own() -> None:
    line, dev = modbus("holding:1", "holding:2", write=REPEAT)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, dev, [("holding:1", 1), ("holding:2", 2)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [1, 2]
        assert len(writes(line, asked)) == 2


@on_virtual_time
async def test_a_device_that_takes_one_register_at_a_time_gets_a_group_one_by_one() -> None:
    """It refuses the function: nothing was done, so each is sent alone."""
    line, dev = modbus("holding:1", "holding:2", "holding:3")
    station = line.stations[0]

    def single_only(data: bytes) -> list[bytes] | None:
        return None if data[1] != 16 else [exception(16, 1)]

    intercept(station, single_only)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit(line, dev, [("holding:2", 2), ("holding:1", 1), ("holding:3", 3)])
        await asyncio.sleep(1)
        assert values_of(outcomes) == [2, 1, 3]
        starts = [(data[1], data[3]) for data in writes(line, asked)]
        assert starts == [(16, 1), (6, 2), (6, 1), (6, 3)]


@on_virtual_time
async def test_a_run_that_was_refused_perhaps_in_part_is_read_back_with_one_request() -> None:
    line, dev = modbus("holding:1", "holding:2", "holding:3", "holding:9")
    station = line.stations[0]

    def in_part(data: bytes) -> list[bytes] | None:
        if data[1] != 16:
            return None
        station.memory.write("holding", 1, [1])
        return [exception(16, 3)]

    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        intercept(station, in_part)
        values = [("holding:1", 1), ("holding:2", 77), ("holding:3", 78), ("holding:9", 9)]
        outcomes = submit(line, dev, values)
        await asyncio.sleep(1)
        assert values_of(outcomes) == [1, "Unclear", "Unclear", "NotSent"]
        assert [data[1] for data in sent(line, asked)][:2] == [16, 3]
        assert len(writes(line, asked)) == 1


@on_virtual_time
async def test_an_unclear_run_is_read_back_for_its_tags_with_verify_alone() -> None:
    tags = [make_tag(text, write=RULE if text == "D2" else VERIFY, **SLOW) for text in RUN]
    dev = device(tags)
    line = plant([dev])
    station = line.stations[0]

    def deaf_after(data: bytes) -> list[bytes] | None:
        if data[3:5] != b"61":
            return None
        station.memory.write("D", 0, [5, 6, 7])
        return []

    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        intercept(station, deaf_after)
        outcomes = submit(line, dev, [("D0", 5), ("D1", 6), ("D2", 7)])
        await asyncio.sleep(4)
        assert values_of(outcomes) == [5, 6, "NoReply"]
        assert len(writes(line, asked)) == 1


# Longer than one request


def long(**settings: Any) -> tuple[Plant, Device]:
    """A text of ten registers for a slave that takes four in one request."""
    driver = ModbusRtu(station=1, max_write_words=4)
    tags = [make_tag("holding:100", driver, type="string[20]", write=WriteRule(**settings), **SLOW)]
    made = slave(driver, tags)
    return slaves([made]), made


@pytest.mark.parametrize("verify", [False, True])
@on_virtual_time
async def test_a_long_write_goes_in_the_fewest_requests_in_order(verify: bool) -> None:
    line, dev = long(verify=verify)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcome = line.submit(dev, dev.tags[0], "ABCDEFGHIJKLMNOPQRST")
        await asyncio.sleep(1)
        assert outcome.once.value == "ABCDEFGHIJKLMNOPQRST"
        assert outcome.once.verified is verify
        assert [(d[1], d[3], d[5]) for d in writes(line, asked)] == [
            *((16, 100, 4), (16, 104, 4), (16, 108, 2))
        ]


@pytest.mark.parametrize(
    ("fault", "at", "kind", "said"),
    [
        ("refused", 100, Refused, "holding:100..holding:103 was refused"),
        ("refused", 104, Unclear, "holding:104..holding:107 was refused"),
        ("silent", 104, Unclear, "holding:104..holding:107 is unknown"),
        ("silent", 108, Unclear, "holding:108..holding:109 is unknown"),
    ],
)
@on_virtual_time
async def test_a_long_write_that_breaks_off_accounts_for_every_address(
    fault: str, at: int, kind: type[Exception], said: str
) -> None:
    line, dev = long()

    def fails(data: bytes) -> list[bytes] | None:
        if data[1] != 16 or data[3] != at:
            return None
        return [] if fault == "silent" else [exception(16, 3)]

    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        intercept(line.stations[0], fails)
        outcome = line.submit(dev, dev.tags[0], "ABCDEFGHIJKLMNOPQRST")
        await asyncio.sleep(4)
        assert type(outcome.once) is kind
        text = str(outcome.once)
        assert said in text
        assert ("is in the PLC" in text) == (at > 100)
        assert ("was not sent" in text) == (at < 108)
        assert [data[3] for data in writes(line, asked)] == list(range(100, at + 1, 4))


@on_virtual_time
async def test_an_array_that_the_device_holds_otherwise_names_its_elements() -> None:
    tags = [make_tag("D100", type="uint16[8]", write=VERIFY, **SLOW)]
    dev = device(tags)
    line = plant([dev])
    station = line.stations[0]
    write = station.memory.write

    def but_some(area: str, start: int, values: Iterable[int]) -> None:
        write(area, start, values)
        write(area, 103, [99, 4, 99, 99, 99])

    async with running(line):
        await asyncio.sleep(3)
        station.memory.write = but_some  # type: ignore[method-assign]  # a program sets them
        outcome = line.submit(dev, tags[0], tuple(range(8)))
        await asyncio.sleep(1)
        text = "acknowledged, but the device now holds 99 in element 3, 99 in element 5, "
        assert str(outcome.once) == f"{text}99 in element 6 and 1 more"


@on_virtual_time
async def test_no_request_of_a_long_write_ends_inside_a_number() -> None:
    """Five registers fit in one request: two numbers, not two and a half."""
    driver = ModbusRtu(station=1, max_write_words=5)
    tags = [make_tag("holding:100", driver, type="float32[5]", write=RULE, **SLOW)]
    dev = slave(driver, tags)
    line = slaves([dev])
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcome = line.submit(dev, tags[0], (1.5, 2.5, 3.5, 4.5, 5.5))
        await asyncio.sleep(1)
        assert outcome.once.value == (1.5, 2.5, 3.5, 4.5, 5.5)
        assert [(data[3], data[5]) for data in writes(line, asked)] == [
            *((100, 4), (104, 4), (108, 2))
        ]


@on_virtual_time
async def test_an_array_of_bits_never_writes_the_bits_around_it() -> None:
    """M8 to M15 fill a byte. The others are forced, because M5 and M17 are not of the array."""
    tags = [make_tag("M6", type="bool[11]", write=RULE, **SLOW), make_tag("M17", **SLOW)]
    dev = device(tags)
    line = plant([dev])
    value = (True, False, True, True) * 2 + (True, True, True)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcome = line.submit(dev, tags[0], value)
        await asyncio.sleep(1)
        assert outcome.once.value == value
        assert [data[3:5] for data in writes(line, asked)] == [b"70", b"71", b"61", b"70"]
        assert line.stations[0].memory.read("M", 6, 11) == [int(bit) for bit in value]


def bits() -> tuple[Plant, Device]:
    """200 points of a PLC that takes 160 in one request, and acknowledges all writes alike."""
    driver = ComputerLink(station=5, profile="fx")
    made = link_device(driver, "M0", type="bool[200]", write=RULE, every=60.0)
    return link_plant([made]), made


@on_virtual_time
async def test_between_the_requests_of_a_long_write_a_resync_tells_their_replies_apart() -> None:
    line, dev = bits()
    value = tuple(n % 3 == 0 for n in range(200))
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcome = line.submit(dev, dev.tags[0], value)
        await asyncio.sleep(2)
        assert outcome.once.value == value
        assert line.stations[0].memory.read("M", 0, 200) == [int(bit) for bit in value]
        assert commands(line.stations[0], asked)[:4] == ["WW", "TT", "BW", "TT"]


@on_virtual_time
async def test_an_acknowledgement_that_comes_twice_acknowledges_no_second_request() -> None:
    """The second request is lost, and the copy of the first reply looks like its reply."""
    line, dev = bits()
    station = line.stations[0]

    def twice(data: bytes) -> list[bytes] | None:
        if data[5:7] == b"BW":
            return []
        return None if data[5:7] != b"WW" else [b"\x0605FF", b"\x0605FF"]

    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        intercept(station, twice)
        outcome = line.submit(dev, dev.tags[0], (True,) * 200)
        await asyncio.sleep(4)
        assert isinstance(outcome.once, Unclear)
        assert str(outcome.once).startswith(
            "M0..M159 (elements 0 to 159) is unknown, M160..M199 (elements 160 to 199) was not "
            "sent: two replies arrived"
        )
        assert "BW" not in commands(station, asked)


def exception(function: int, code: int) -> bytes:
    """An exception reply of slave 1, with its CRC."""
    data = bytes([1, 0x80 | function, code])
    return data + crc16(data)
