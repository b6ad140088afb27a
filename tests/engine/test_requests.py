"""Requests on a simulated line: writes in one exchange, the latest of several, commands."""

import asyncio
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.engine.device.device import Device
from gateway.errors import BadValue, Busy, LineDown, Refused, Unclear
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.vigor import Vigor
from gateway.tags import WriteResult, WriteRule
from tests.engine.misbehaving import intercept
from tests.sim.bench import WIRE
from tests.sim.links import commands, link_device, link_plant, spelt
from tests.sim.plant import Outcome, Plant, device, made_device, plant, running, words
from tests.sim.virtual import on_virtual_time, run_virtual

BITS = [f"M{7 * n}" for n in range(20)]
WORDS = [f"D{30 * n}" for n in range(10)]
WRITE = {"write": WriteRule(), "every": 60.0}


def now() -> float:
    return asyncio.get_running_loop().time()


def one(*addresses: str, **options: Any) -> tuple[Plant, Device]:
    dev = link_device(ComputerLink(station=5), *addresses, **{**WRITE, **options})
    return link_plant([dev]), dev


def submit_all(line: Plant, dev: Device, values: dict[str, Any]) -> dict[str, Outcome]:
    """Submits all of them before the line sends anything."""
    return {text: line.submit(dev, spelt(dev, text), value) for text, value in values.items()}


def written(outcomes: dict[str, Outcome]) -> dict[str, Any]:
    found = {}
    for text, outcome in outcomes.items():
        assert isinstance(outcome.once, WriteResult), (text, outcome.once)
        found[text] = outcome.once.value
    return found


# Together


@pytest.mark.parametrize(
    ("addresses", "command", "values"),
    [
        (BITS, "BT", dict(zip(BITS, [True, False] * 10, strict=True))),
        (WORDS, "WT", {text: 100 + n for n, text in enumerate(WORDS)}),
    ],
    ids=["20 bits", "10 words"],
)
@on_virtual_time
async def test_scattered_writes_that_wait_together_are_sent_in_one_exchange(
    addresses: list[str], command: str, values: dict[str, Any]
) -> None:
    line, dev = one(*addresses)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit_all(line, dev, values)
        await asyncio.sleep(2)
        assert commands(line.stations[0], asked)[0] == command
        assert not {"BW", "WW"} & set(commands(line.stations[0], asked))
        assert commands(line.stations[0], asked).count(command) == 1
        assert written(outcomes) == values
    memory = line.stations[0].memory
    held = {text: memory.read(text[0], int(text[1:]))[0] for text in addresses}
    assert held == values
    assert dev.record.writes == len(addresses)


@on_virtual_time
async def test_writes_that_do_not_fit_one_exchange_are_sent_in_the_next() -> None:
    line, dev = one(*BITS, "S100", "S200")
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit_all(line, dev, dict.fromkeys([*BITS, "S100", "S200"], True))
        await asyncio.sleep(2)
        assert commands(line.stations[0], asked).count("BT") == 2
        assert set(written(outcomes).values()) == {True}


@pytest.mark.parametrize(
    "rule", [WriteRule(verify=True), WriteRule(repeat=True)], ids=["verify", "repeat"]
)
@on_virtual_time
async def test_a_write_with_verify_or_repeat_is_sent_alone(rule: WriteRule) -> None:
    line, dev = one(*WORDS, write=rule)
    async with running(line):
        await asyncio.sleep(3)
        outcomes = submit_all(line, dev, dict.fromkeys(WORDS, 1))
        await asyncio.sleep(3)
        assert "WT" not in commands(line.stations[0])
        assert set(written(outcomes).values()) == {1}


@on_virtual_time
async def test_a_driver_without_scattered_writes_sends_one_after_the_other() -> None:
    dev = device(words(0, 5, write=WriteRule(), every=60.0))
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1)
        outcomes = [line.submit(dev, tag, n) for n, tag in enumerate(dev.tags)]
        await asyncio.sleep(1)
        assert all(isinstance(outcome.once, WriteResult) for outcome in outcomes)
    assert len(line.writes_sent()) == 5


@on_virtual_time
async def test_a_damaged_group_is_sent_again_one_by_one_with_outcomes_of_their_own() -> None:
    line, dev = one(*BITS)
    intercept(line.stations[0], damaged_group)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit_all(line, dev, dict.fromkeys(BITS, True))
        await asyncio.sleep(4)
        refused = outcomes.pop("M21").once
        assert isinstance(refused, Refused)
        assert refused.code == "06"
        assert set(written(outcomes).values()) == {True}
        sent = commands(line.stations[0], asked)
        assert (sent.count("BT"), sent.count("BW")) == (1, 20)


@on_virtual_time
async def test_a_known_bad_address_leaves_the_other_writes_together() -> None:
    line, dev = one(*BITS)
    line.stations[0].inner.memory.holes = {("M", 21)}
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit_all(line, dev, dict.fromkeys(BITS, True))
        await asyncio.sleep(4)
        assert isinstance(outcomes.pop("M21").once, Refused)
        assert set(written(outcomes).values()) == {True}
        sent = [c for c in commands(line.stations[0], asked) if c in ("BT", "BW")]
        assert sent == ["BT", "BW", "BT"]


@on_virtual_time
async def test_a_group_that_was_refused_in_part_is_read_back_and_never_sent_again() -> None:
    line, dev = one(*WORDS[:4])
    station = line.stations[0]

    def in_part(data: bytes) -> list[bytes] | None:
        if data[5:7] != b"WT":
            return None
        for entry in (data[10:19], data[19:28]):  # the first two of four
            station.memory.write("D", int(entry[1:5]), [int(entry[5:9], 16)])
        return [b"\x1505FF06"]

    intercept(station, in_part)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        outcomes = submit_all(line, dev, {text: 7 + n for n, text in enumerate(WORDS[:4])})
        await asyncio.sleep(4)
        results = [outcomes[text].once for text in WORDS[:4]]
        assert [type(result) for result in results] == [WriteResult, WriteResult, Unclear, Unclear]
        assert "perhaps after it was done" in str(results[2])
        assert "WW" not in commands(station, asked)


@on_virtual_time
async def test_a_lost_acknowledgement_makes_every_write_unclear_and_none_is_sent_twice() -> None:
    line, dev = one(*BITS)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        line.stations[0].mute = True
        outcomes = submit_all(line, dev, dict.fromkeys(BITS, True))
        await asyncio.sleep(0.5)
        line.stations[0].mute = False
        await asyncio.sleep(5)
        assert all(isinstance(outcome.once, Unclear) for outcome in outcomes.values())
        sent = commands(line.stations[0], asked)
        assert (sent.count("BT"), sent.count("BW")) == (1, 0)
        after = sent[sent.index("BT") + 1]
        assert after == "TT"  # the device needs a resync before anything else


@on_virtual_time
async def test_a_line_that_goes_down_makes_sent_writes_unclear_and_ends_waiting_ones_not_sent() -> (
    None
):
    line, dev = one(*BITS, *WORDS)
    async with running(line):
        await asyncio.sleep(3)
        outcomes = submit_all(line, dev, dict.fromkeys(BITS, True))
        waiting = submit_all(line, dev, dict.fromkeys(WORDS, 1))
        while not line.writes_sent(now()) and line.bench.sent[-1][1][5:7] != b"BT":
            await asyncio.sleep(0.001)
        line.bench.vanish()
        await asyncio.sleep(0.1)
        assert all(isinstance(outcome.once, Unclear) for outcome in outcomes.values())
        assert all(isinstance(outcome.once, LineDown) for outcome in waiting.values())
        line.bench.come_back()
        await asyncio.sleep(5)
        assert all(len(outcome.outcomes) == 1 for outcome in (outcomes | waiting).values())
    assert line.stations[0].memory.read("D", 0) == [0]


@pytest.mark.parametrize("obeys", [True, False])
@on_virtual_time
async def test_after_a_refused_group_no_late_reply_counts_for_the_next_write(obeys: bool) -> None:
    """Each write needs a resync of its own: the write after an unclear one waits for it."""
    line, dev = one("M0", "M21", "M42", "M63", guard=0.05)
    station = line.stations[0]
    intercept(station, damaged_group)
    deaf = 0

    def late(_: Any) -> float:
        nonlocal deaf
        if station.heard[-1][1][5:13] == b"BW0M0000" and obeys:
            deaf += 1
            return 0.5  # beyond time-out and guard
        return 0.0

    station.late = late
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        if not obeys:
            intercept(station, lambda data: [] if data[5:13] == b"BW0M0000" else None)
        outcomes = submit_all(line, dev, dict.fromkeys(["M0", "M21", "M42", "M63"], True))
        await asyncio.sleep(5)
        assert isinstance(outcomes["M0"].once, Unclear)
        assert isinstance(outcomes["M21"].once, Refused)
        assert isinstance(outcomes["M42"].once, WriteResult)
        assert isinstance(outcomes["M63"].once, WriteResult)
        assert commands(station, asked)[:2] == ["BT", "BW"]
        assert commands(station, asked)[2] in ("TT", "BR")  # the resync
        assert deaf == obeys


@on_virtual_time
async def test_a_refused_group_is_not_sent_on_to_a_device_that_went_offline() -> None:
    line, dev = one("M0", "M21", "M42", retries=0)
    station = line.stations[0]
    intercept(station, damaged_group)
    async with running(line):
        await asyncio.sleep(3)
        outcomes = submit_all(line, dev, dict.fromkeys(["M0", "M21", "M42"], True))
        while "BT" not in commands(station):
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.03)
        station.mute = True
        await asyncio.sleep(5)
        assert isinstance(outcomes["M0"].once, Unclear)
        for name in ("M21", "M42"):  # both were sent once
            assert str(outcomes[name].once).startswith("station 5 answered NAK 02")
        assert commands(station).count("BW") == 1


def damaged_group(data: bytes) -> list[bytes] | None:
    """Refuses BT as damaged, and M21 for ever."""
    if data[5:7] == b"BT":
        return [b"\x1505FF02"]
    return [b"\x1505FF06"] if data[5:13] == b"BW0M0021" else None


# In order

_CHOICE = st.sampled_from(["M0", "M40", "S7", "D5", "D90", "D91", "X20"])


@given(
    orders=st.lists(st.tuples(_CHOICE, st.integers(0, 1)), min_size=1, max_size=40),
    holes=st.sets(_CHOICE, max_size=1),
)
@settings(max_examples=40)
def test_a_device_gets_all_its_requests_in_their_order(
    orders: list[tuple[str, int]], holes: set[str]
) -> None:
    async def whole() -> None:
        line, dev = one("M0", "M40", "S7", "D5", "D90", "D91", "X20")
        obeyed: list[tuple[str, int]] = []
        station = line.stations[0]
        write = station.memory.write
        station.inner.memory.holes = {(t[0], int(t[1:], 8 if t[0] == "X" else 10)) for t in holes}

        def noted(area: str, start: int, values: Any) -> None:
            for number, value in enumerate(values, start):
                text = f"{area}{number:o}" if area == "X" else f"{area}{number}"
                obeyed.append((text, value))
            write(area, start, values)

        async with running(line):
            await asyncio.sleep(5)
            station.memory.write = noted  # type: ignore[method-assign]  # notes the order
            outcomes = [line.submit(dev, spelt(dev, text), value) for text, value in orders]
            await asyncio.sleep(4)
        assert obeyed == [order for order in orders if order[0] not in holes]
        for (text, value), outcome in zip(orders, outcomes, strict=True):
            if text in holes:
                assert isinstance(outcome.once, Refused)
            else:
                assert isinstance(outcome.once, WriteResult)
                assert outcome.once.value == value

    run_virtual(whole())


@on_virtual_time
async def test_of_several_waiting_values_only_the_latest_is_sent() -> None:
    line, dev = one("D5", "D90", write=WriteRule(latest=True))
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        tags = spelt(dev, "D5"), spelt(dev, "D90")
        first, second, third = (line.submit(dev, tags[0], n) for n in (1, 2, 3))
        other = line.submit(dev, tags[1], 9)
        await asyncio.sleep(1)
        for outcome in (first, second):
            assert isinstance(outcome.once, Busy)
            assert "newer value" in str(outcome.once)
        assert isinstance(third.once, WriteResult)
        assert isinstance(other.once, WriteResult)
        assert commands(line.stations[0], asked)[0] == "WT"
        assert line.stations[0].memory.read("D", 5) == [3]


@on_virtual_time
async def test_without_latest_every_value_is_sent() -> None:
    line, dev = one("D5")
    async with running(line):
        await asyncio.sleep(3)
        outcomes = [line.submit(dev, dev.tags[0], n) for n in (1, 2, 3)]
        await asyncio.sleep(2)
        assert [o.once.value for o in outcomes if isinstance(o.once, WriteResult)] == [1, 2, 3]
        assert "WT" not in commands(line.stations[0])  # the same register twice: not in one


# Commands


@on_virtual_time
async def test_commands_reach_the_plc_and_return_its_answer() -> None:
    line, dev = one("D5", control=True)
    async with running(line):
        await asyncio.sleep(3)
        model = line.command(dev, "model")
        loopback = line.command(dev, "loopback", "HELLO")
        await asyncio.sleep(1)
        assert (model.once, loopback.once) == ("9E (FX1N)", "HELLO")
        refused = line.command(dev, "run")
        await asyncio.sleep(1)
        assert isinstance(refused.once, Refused)
        assert refused.once.code == "18"
        stopped = line.command(dev, "stop")
        await asyncio.sleep(1)
        assert stopped.once == "acknowledged"
        assert not is_running(line)
        on = line.command(dev, "global", "on")
        await asyncio.sleep(1)
        assert on.once == "sent to all stations, none answers"
        assert line.stations[0].memory.read("M8", 8126) == [1]
        assert dev.health.consecutive_failures == 0


@pytest.mark.parametrize(
    ("control", "name", "argument", "why"),
    [
        (False, "stop", "", "control: true"),
        (True, "format", "", "none of its commands"),
        (True, "stop", "now", "takes no argument"),
        (True, "loopback", "Ä", "printable"),
        (True, "global", "perhaps", "on or off"),
    ],
)
@on_virtual_time
async def test_a_command_that_may_not_be_sent_is_refused_and_not_sent(
    control: bool, name: str, argument: str, why: str
) -> None:
    line, dev = one("D5", control=control)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        refusal = await outcome(line, dev, name, argument)
        assert isinstance(refusal, BadValue)
        assert why in str(refusal)
        assert commands(line.stations[0], asked) == []


@on_virtual_time
async def test_a_device_of_another_protocol_takes_no_commands() -> None:
    driver = Vigor(station=1)
    dev = made_device("plc", driver, WIRE, driver.timing, words(0, 1), control=True)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1)
        refusal = await outcome(line, dev, "stop")
        assert isinstance(refusal, BadValue)
        assert "takes no commands" in str(refusal)


@on_virtual_time
async def test_a_command_whose_answer_is_lost_is_unclear() -> None:
    line, dev = one("D5", control=True)
    async with running(line):
        await asyncio.sleep(3)
        line.stations[0].mute = True
        assert isinstance(await outcome(line, dev, "stop"), Unclear)
        assert not is_running(line)
        line.stations[0].mute = False
        assert await outcome(line, dev, "model") == "9E (FX1N)"
        assert commands(line.stations[0])[-3:] == ["RS", "TT", "PC"]  # the resync goes first


@on_virtual_time
async def test_a_line_that_goes_down_during_a_command_makes_it_unclear() -> None:
    line, dev = one("D5", control=True)
    async with running(line):
        await asyncio.sleep(3)
        stopped = line.command(dev, "stop")
        while line.bench.sent[-1][1][5:7] != b"RS":
            await asyncio.sleep(0.001)
        line.bench.vanish()
        await asyncio.sleep(2)
        assert isinstance(stopped.once, Unclear)
        assert isinstance(await outcome(line, dev, "stop"), LineDown)


@on_virtual_time
async def test_a_command_is_not_overtaken_by_writes() -> None:
    line, dev = one("M0", "M40", "S7", control=True)
    async with running(line):
        await asyncio.sleep(3)
        asked = now()
        line.submit(dev, spelt(dev, "M0"), True)
        line.submit(dev, spelt(dev, "M40"), True)
        line.command(dev, "stop")
        line.submit(dev, spelt(dev, "S7"), True)
        await asyncio.sleep(1)
        sent = [c for c in commands(line.stations[0], asked) if c not in ("BR", "WR")]
        # All acknowledgements are equal. A loopback shows that none of them arrived twice.
        assert sent == ["BT", "TT", "RS", "BW", "TT"]


async def outcome(line: Plant, dev: Device, name: str, argument: str = "") -> Any:
    """The outcome of a command, two seconds later."""
    found = line.command(dev, name, argument)
    await asyncio.sleep(2)
    return found.once


def is_running(line: Plant) -> bool:
    station: Any = line.stations[0].inner
    return bool(station.link.running)
