"""The outcome of one write, by the rules of its tag."""

import asyncio

import pytest
from structlog.testing import capture_logs

from gateway.engine.device.device import Device
from gateway.engine.results.request_rules import Differs
from gateway.errors import Refused, Unclear
from gateway.protocols.vigor.codec import Reply, encode
from gateway.tags import Tag, WriteResult, WriteRule
from tests.sim.plant import Outcome, Plant, device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time


def one(rule: WriteRule, text: str = "D0") -> tuple[Plant, Device, Tag]:
    tag = make_tag(text, write=rule, every=30.0)
    dev = device([tag], reply_timeout=0.2, guard=0.2)
    return plant([dev]), dev, tag


def deafen(line: Plant, command: bytes, times: int = 1, *, obeys: bool = False) -> None:
    """The station does not reply to the next `times` requests of this command.

    `obeys`: it carries them out.
    """
    station = line.stations[0]

    def sometimes(request: bytes, now: float) -> list[bytes]:
        nonlocal times
        if request[3:5] == command and times:
            times -= 1
            if obeys:
                station.inner.hear(request, now)
            return []
        return station.inner.hear(request, now)

    station.answer = sometimes


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


@pytest.mark.parametrize(
    ("reply", "why"),
    [
        (b"\xff\x01\x80", "no whole frame"),
        (encode(Reply(2, "51", "00", bytes(2))), "another station spoke"),
    ],
)
@on_virtual_time
async def test_the_log_has_the_bytes_of_a_strange_reply_and_no_sentence_has(
    reply: bytes, why: str
) -> None:
    """Neither the outcome of a write nor the detail of a value."""
    near, far = make_tag("D0", write=WriteRule()), make_tag("D1000")
    line = plant([device([near, far], reply_timeout=0.2, guard=0.2)])
    station = line.stations[0]

    def strange(request: bytes, now: float) -> list[bytes]:
        found = station.inner.hear(request, now)
        is_asked = request[3:5] == b"61" or request[5:9] == b"23D0"  # of D1000
        return [reply] if is_asked else found

    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(1)
            station.answer = strange
            unclear = (await write(line)).once
            await asyncio.sleep(10)
    assert isinstance(unclear, Unclear)
    assert str(unclear) == line.now[far].detail == why
    failed = [entry for entry in logs if entry["event"] == "transaction failed"]
    assert len(failed) > 1
    assert {(entry["why"], entry["bytes"]) for entry in failed} == {(why, reply.hex(" "))}


@pytest.mark.parametrize("obeys", [False, True])
@on_virtual_time
async def test_without_a_rule_an_unacknowledged_write_ends_unclear(obeys: bool) -> None:
    line, _, _ = one(WriteRule())
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"61", obeys=obeys)
        assert isinstance((await write(line)).once, Unclear)
    assert len(line.writes_sent()) == 1


@pytest.mark.parametrize("obeys", [False, True])
@on_virtual_time
async def test_verify_reads_an_unacknowledged_write_back(obeys: bool) -> None:
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
async def test_verify_and_repeat_send_again_only_a_lost_write() -> None:
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
async def test_a_refused_repetition_leaves_the_write_unclear() -> None:
    """The station carried out the first try; only its acknowledgement was lost."""
    line, _, _tag = one(WriteRule(repeat=True))
    async with running(line):
        await asyncio.sleep(1)
        station, tries = line.stations[0].inner, 0

        def once(request: bytes, now: float) -> list[bytes]:
            nonlocal tries
            if request[3:5] != b"61":
                return station.hear(request, now)
            tries += 1
            if tries == 1:
                station.hear(request, now)
                return []
            station.memory.holes = {("D", 0)}
            refusal = station.hear(request, now)
            station.memory.holes = set()
            return refusal

        line.stations[0].answer = once
        outcome = (await write(line)).once
    assert station.memory.read("D", 0) == [5]
    assert tries == 2
    assert isinstance(outcome, Unclear)


@on_virtual_time
async def test_a_refused_read_back_leaves_the_write_unclear() -> None:
    line, dev, _ = one(WriteRule(verify=True))
    async with running(line):
        await asyncio.sleep(1)
        station = line.stations[0].inner

        def after(request: bytes, now: float) -> list[bytes]:
            replies = station.hear(request, now)
            if request[3:5] == b"61":
                station.memory.holes = {("D", 0)}
            return replies

        line.stations[0].answer = after
        outcome = (await write(line)).once
    assert station.memory.read("D", 0) == [5]
    assert isinstance(outcome, Unclear)
    assert "acknowledged" in str(outcome)
    assert dev.health.consecutive_failures == 0


@on_virtual_time
async def test_verify_reports_a_differing_value() -> None:
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
async def test_a_refused_write_is_not_repeated() -> None:
    line, dev, _ = one(WriteRule(repeat=True, verify=True))
    async with running(line):
        await asyncio.sleep(1)
        line.stations[0].inner.memory.holes = {("D", 0)}
        outcome = (await write(line)).once
    assert isinstance(outcome, Refused)
    assert len(line.writes_sent()) == 1
    assert dev.record.refusals["28"] >= 1


@on_virtual_time
async def test_an_expired_write_is_not_repeated() -> None:
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
async def test_a_bit_write_whose_word_cannot_be_read_sends_no_write() -> None:
    line, _, _ = one(WriteRule(), "D7.3")
    async with running(line):
        await asyncio.sleep(1)
        deafen(line, b"51", times=1)
        outcome = line.submit(line.devices[0], line.devices[0].tags[0], True)
        await asyncio.sleep(3)
        assert isinstance(outcome.once, Unclear)
    assert line.writes_sent() == []


@on_virtual_time
async def test_b3_8_a_telephone_number_is_written_and_read_back() -> None:
    number = make_tag("D9110", type="telephone", write=WriteRule(verify=True))
    dev = device([number])
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(dev, number, "2620-4976")
        await asyncio.sleep(3)
        assert isinstance(outcome.once, WriteResult)
        assert outcome.once.value == "2620-4976"
        assert line.now[number].value == "2620-4976"
        assert line.stations[0].memory.read("D9", 9110, 6) == [0x0262, 0x6794, 0xE, 0, 0, 0]


@on_virtual_time
async def test_a_bit_of_a_bit_area_is_written_alone() -> None:
    line, _, tag = one(WriteRule(verify=True), "M12")
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], tag, True)
        await asyncio.sleep(1)
        assert isinstance(outcome.once, WriteResult)
        assert outcome.once.verified
    assert line.stations[0].memory.read("M", 8, 8) == [0, 0, 0, 0, 1, 0, 0, 0]
