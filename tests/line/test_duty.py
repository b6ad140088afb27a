"""A write is sent only while the duty of the gateway is proven."""

import asyncio
import time

import pytest

from gateway.engine.jobs.requests import Write
from gateway.errors import Busy
from gateway.line.arrival import HELD, PERIOD, ArrivalClock
from gateway.line.perform import perform
from gateway.line.send_permit import PROOF_VALID, SETTLE, SendPermit
from gateway.tags import WriteResult, WriteRule
from tests.line.fake_port import FakePort, opened
from tests.sim.plant import device, make_tag, plant, running
from tests.sim.virtual import on_virtual_time


def test_what_arrived_before_a_hold_or_soon_after_it_is_of_the_past() -> None:
    duty = SendPermit(lambda: 100.0)
    for since, now in ((95.0, 100.0), (100.0, 100.0), (100.9 * SETTLE, 103.0)):
        assert "stood still" in duty.why_not(since, now)
    assert duty.why_not(100.0 + SETTLE, 102.0) == ""
    assert SendPermit().why_not(0.0, 0.0) == ""


def test_a_shared_duty_counts_while_it_is_proven() -> None:
    duty = SendPermit(shared=True)
    assert "may be active" in duty.why_not(5.0, 5.0)
    duty.prove(5.0)
    assert duty.why_not(5.0, 5.0 + PROOF_VALID) == ""
    assert "may be active" in duty.why_not(5.0, 5.1 + PROOF_VALID)


def test_a_held_process_is_noticed_before_and_after_the_timer_ran() -> None:
    async def attack() -> list[bool]:
        clock = ArrivalClock()
        clock.start()
        await asyncio.sleep(PERIOD)
        loop = asyncio.get_running_loop()
        noticed, before = [clock.released() > 0.0], loop.time()
        time.sleep(HELD + PERIOD)  # the attack
        noticed.append(clock.released() > before)
        await asyncio.sleep(PERIOD)
        noticed.append(clock.released() > before)
        clock.stop()
        return noticed

    assert asyncio.run(attack()) == [False, True, True]


@pytest.mark.parametrize("bit", [False, True])
@on_virtual_time
async def test_a_hold_in_the_middle_of_a_transaction_keeps_the_write_off_the_wire(
    bit: bool,
) -> None:
    """A bit is changed in its word: the word was read before the hold."""
    held = [-1e9]
    tag = make_tag("D0.3" if bit else "D0", write=WriteRule())
    dev, port = device([tag]), FakePort()
    now = asyncio.get_running_loop().time()
    quiet_since = 0.0 if bit else now + 0.2  # the line must be silent first
    talk = opened(port, quiet_since=quiet_since, duty=SendPermit(lambda: held[0]))
    write = Write(dev, tag, [1], now)
    writing = asyncio.create_task(perform(write, talk))
    await asyncio.sleep(0.05)
    held[0] = asyncio.get_running_loop().time()
    result = await writing
    assert isinstance(result, Busy)
    assert "stood still" in str(result)
    assert len(port.sent) == (1 if bit else 0)


@on_virtual_time
async def test_a_write_that_was_not_sent_is_busy_and_the_line_goes_on() -> None:
    held = [-1e9]
    tag = make_tag("D0", write=WriteRule())
    dev = device([tag])
    line = plant([dev], duty=SendPermit(lambda: held[0]))
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(dev, tag, 5)
        held[0] = asyncio.get_running_loop().time()
        await asyncio.sleep(2)
        assert isinstance(outcome.once, Busy)
        assert line.good(dev)
        outcome = line.submit(dev, tag, 6)
        await asyncio.sleep(1)
        assert isinstance(outcome.once, WriteResult)


@on_virtual_time
async def test_a_request_expires_by_its_own_time_whatever_waits_before_it() -> None:
    tags = [make_tag("D0", write=WriteRule()), make_tag("D40", write=WriteRule())]
    dev = device(tags, reply_timeout=3.0)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1)
        line.stations[0].mute = True
        began = asyncio.get_running_loop().time()
        line.submit(dev, tags[0], 1)
        await asyncio.sleep(0.1)
        line.submit(dev, tags[0], 2)
        hasty = line.line.write(dev, tags[1], [3], within=0.5)
        with pytest.raises(Busy, match="waited"):
            await hasty
        assert asyncio.get_running_loop().time() - began < 1.0
