"""One write from the first byte to its outcome: what each rule allows and what is said of it."""

import asyncio

import pytest

from gateway.engine.device import Device
from gateway.engine.request_results import Differs
from gateway.errors import Refused, Unclear
from gateway.tags import Tag, WriteResult, WriteRule
from tests.sim.plant import Outcome, Plant, device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time


def one(rule: WriteRule, text: str = "D0") -> tuple[Plant, Device, Tag]:
    tag = make_tag(text, write=rule, every=30.0)
    dev = device([tag], reply_timeout=0.2, guard=0.2)
    return plant([dev]), dev, tag


def deafen(line: Plant, command: bytes, times: int = 1, *, obeys: bool = False) -> None:
    """The station does not answer the next `times` requests of this command."""
    station = line.stations[0].inner
    answer = station._answer  # private: the station's rule is changed between two frames

    def sometimes(request: bytes, now: float) -> object:
        nonlocal times
        if request[3:5] == command and times:
            times -= 1
            if obeys:
                answer(request, now)
            return None
        return answer(request, now)

    station._answer = sometimes  # type: ignore[method-assign,assignment]


async def write(line: Plant, value: int = 5) -> Outcome:
    dev = line.devices[0]
    outcome = line.submit(dev, dev.tags[0], value)
    await asyncio.sleep(4)
    return outcome


@on_virtual_time
async def test_an_acknowledged_write_is_done() -> None:
    line, dev, _ = one(WriteRule())
    async with running(line):
        await asyncio.sleep(1)
        done = (await write(line)).once
    assert isinstance(done, WriteResult)
    assert (done.value, done.verified, done.acknowledged) == (5, False, True)
    assert 0 < done.took < 0.2
    assert dev.record.writes == 1
    assert dev.record.slowest_write == pytest.approx(done.took)


@pytest.mark.parametrize("obeys", [False, True])
@on_virtual_time
async def test_without_a_rule_a_write_that_was_not_acknowledged_is_unclear(obeys: bool) -> None:
    line, _, _ = one(WriteRule())
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61", obeys=obeys)
        assert isinstance((await write(line)).once, Unclear)
    assert len(line.writes_sent()) == 1


@pytest.mark.parametrize("obeys", [False, True])
@on_virtual_time
async def test_verify_reads_back_what_became_of_it(obeys: bool) -> None:
    line, _, _ = one(WriteRule(verify=True))
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61", obeys=obeys)
        done = (await write(line)).once
    assert len(line.writes_sent()) == 1
    if obeys:
        assert isinstance(done, WriteResult)
        assert done.verified
    else:
        assert isinstance(done, Unclear)


@on_virtual_time
async def test_repeat_sends_once_more() -> None:
    line, _, _ = one(WriteRule(repeat=True))
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61")
        assert isinstance((await write(line)).once, WriteResult)
        deafen(line, b"61", times=9)
        assert isinstance((await write(line, 6)).once, Unclear)
    assert len(line.writes_sent()) == 2 + 2


@on_virtual_time
async def test_verify_and_repeat_send_again_only_what_was_not_done() -> None:
    line, _, _ = one(WriteRule(verify=True, repeat=True))
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61", obeys=True)
        done = (await write(line)).once
        assert isinstance(done, WriteResult)
        assert done.verified
        assert len(line.writes_sent()) == 1
        deafen(line, b"61")
        done = (await write(line, 6)).once
        assert isinstance(done, WriteResult)
        assert done.verified
        assert len(line.writes_sent()) == 3


@on_virtual_time
async def test_a_refusal_of_the_repetition_says_nothing_of_the_first_try() -> None:
    """The first was obeyed, only its acknowledgement was lost: "refused" would be a lie."""
    line, _, _tag = one(WriteRule(repeat=True))
    async with running(line):
        await asyncio.sleep(1)
        station = line.stations[0].inner
        answer, tries = station._answer, 0

        def once(request: bytes, now: float) -> object:
            nonlocal tries
            if request[3:5] != b"61":
                return answer(request, now)
            tries += 1
            if tries == 1:
                answer(request, now)
                return None
            station.holes = {("D", 0)}
            refusal = answer(request, now)
            station.holes = set()
            return refusal

        station._answer = once  # type: ignore[method-assign,assignment]
        outcome = (await write(line)).once
    assert station.memory.read("D", 0) == [5]
    assert tries == 2
    assert isinstance(outcome, Unclear)


@on_virtual_time
async def test_a_refused_reading_back_does_not_make_the_write_refused() -> None:
    line, dev, _ = one(WriteRule(verify=True))
    async with running(line):
        await asyncio.sleep(1)
        station = line.stations[0].inner
        answer = station._answer

        def after(request: bytes, now: float) -> object:
            reply = answer(request, now)
            if request[3:5] == b"61":
                station.holes = {("D", 0)}
            return reply

        station._answer = after  # type: ignore[method-assign,assignment]
        outcome = (await write(line)).once
    assert station.memory.read("D", 0) == [5]
    assert isinstance(outcome, Unclear)
    assert "acknowledged" in str(outcome)
    assert dev.health.consecutive_failures == 0


@on_virtual_time
async def test_a_device_that_holds_something_else_is_said_so() -> None:
    line, dev, _ = one(WriteRule(verify=True))
    line.stations[0].memory.write = lambda area, start, values: None  # type: ignore[method-assign]
    async with running(line):
        await asyncio.sleep(1)
        outcome = (await write(line)).once
        assert isinstance(outcome, Differs)
        assert "now holds 0" in str(outcome)
        assert dev.health.consecutive_failures == 0
    assert len(line.writes_sent()) == 1


@on_virtual_time
async def test_a_write_refused_is_not_repeated() -> None:
    line, dev, _ = one(WriteRule(repeat=True, verify=True))
    async with running(line):
        await asyncio.sleep(1)
        line.stations[0].inner.holes = {("D", 0)}
        outcome = (await write(line)).once
    assert isinstance(outcome, Refused)
    assert len(line.writes_sent()) == 1
    assert dev.record.refusals["28"] >= 1


@on_virtual_time
async def test_a_repetition_is_not_sent_after_the_write_has_expired() -> None:
    tag = make_tag("D0", write=WriteRule(repeat=True), every=30.0)
    dev = device([tag], reply_timeout=4.0, guard=2.0)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61", times=9)
        outcome = line.submit(dev, tag, 5)
        await asyncio.sleep(20)
        assert isinstance(outcome.once, Unclear)
    assert len(line.writes_sent()) == 1


@on_virtual_time
async def test_reading_the_word_of_a_bit_failing_sends_nothing() -> None:
    line, _, _ = one(WriteRule(), "D7.3")
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"51", times=1)
        outcome = line.submit(line.devices[0], line.devices[0].tags[0], True)
        await asyncio.sleep(3)
        assert isinstance(outcome.once, Unclear)
    assert line.writes_sent() == []


@on_virtual_time
async def test_a_bit_area_is_written_bit_by_bit() -> None:
    line, _, tag = one(WriteRule(verify=True), "M12")
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], tag, True)
        await asyncio.sleep(1)
        assert isinstance(outcome.once, WriteResult)
        assert outcome.once.verified
    assert line.stations[0].memory.read("M", 8, 8) == [0, 0, 0, 0, 1, 0, 0, 0]
