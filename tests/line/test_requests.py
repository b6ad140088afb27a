"""Writes on a line: their order among the polls, their expiry, their outcomes."""

import asyncio
import itertools
import random

import pytest

from gateway.engine.jobs.requests import WRITE_EXPIRY
from gateway.errors import Busy, GatewayError, LineDown, Offline, Refused, Unclear
from gateway.tags import WriteResult, WriteRule
from tests.line.clocks import wind_up
from tests.sim.plant import device, make_tag, plant, running, words
from tests.sim.virtual import now, on_virtual_time


@on_virtual_time
async def test_under_full_load_a_write_waits_for_at_most_two_transactions() -> None:
    dev = device(
        [
            *words(0, 50, every=0.02),
            *words(500, 50, every=0.02),
            make_tag("D100", write=WriteRule()),
        ]
    )
    line = plant([dev])
    longest = max(max(dev.poll_seconds(block)) for block in dev.blocks)
    chance = random.Random(1)
    async with running(line):
        await asyncio.sleep(1)
        for value in range(300):
            asked = now()
            alone = line.submit(dev, dev.tags[-1], value)
            await asyncio.sleep(0)
            close = line.submit(dev, dev.tags[-1], value + 1000)
            await asyncio.sleep(1 + chance.random())
            first, second = (at for at, _ in line.writes_sent(asked))
            assert first - asked <= longest + 0.005 + 1e-6
            assert second - first <= 2 * longest + 0.1
            assert isinstance(alone.once, WriteResult)
            assert isinstance(close.once, WriteResult)
            assert alone.at < close.at


@on_virtual_time
async def test_a_stream_of_writes_starves_no_block() -> None:
    dev = device(
        [*words(0, 10, every=0.5), *words(500, 10, every=0.5), make_tag("D100", write=WriteRule())]
    )
    line = plant([dev])
    wind_up(line)
    async with running(line):
        await asyncio.sleep(1)
        start = now()
        for value in range(2000):
            line.submit(dev, dev.tags[-1], value)
            await asyncio.sleep(0.03)
        for tag in (dev.tags[0], dev.tags[10]):
            times = [at for at, s in line.reported if s.tag is tag and start <= at]
            assert max(b - a for a, b in itertools.pairwise(times)) < 1.5


@on_virtual_time
async def test_an_expired_write_is_never_sent() -> None:
    """Fifty writes wait behind a station that loses every acknowledgement."""
    dev = device([make_tag("D0", write=WriteRule(), every=10.0)])
    line = plant([dev])
    station = line.stations[0]
    async with running(line):
        await asyncio.sleep(1)
        station.answer = lambda data, now: (
            [] if data[3:5] == b"61" else station.inner.hear(data, now)
        )
        outcomes = [line.submit(dev, dev.tags[0], value) for value in range(50)]
        asked = now()
        await asyncio.sleep(30)
    sent = line.writes_sent(asked)
    assert max(at for at, _ in sent) < asked + WRITE_EXPIRY + 0.1
    unclear = [o for o in outcomes if isinstance(o.once, Unclear)]
    late = [o for o in outcomes if isinstance(o.once, Busy)]
    assert len(unclear) == len(sent)
    assert len(unclear) + len(late) == 50
    assert len(late) > 30


@on_virtual_time
async def test_port_loss_leaves_the_sent_write_unclear_and_fails_waiting_writes() -> None:
    dev = device([make_tag("D0", write=WriteRule()), *words(10, 20)])
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(1.5)
        outcomes = [line.submit(dev, dev.tags[0], value) for value in range(5)]
        await asyncio.sleep(0.01)  # the first is on the wire
        assert len(line.writes_sent()) == 1
        gone = now()
        line.bench.vanish()
        await asyncio.sleep(0.001)
        assert isinstance(outcomes[0].once, Unclear)
        for outcome in outcomes[1:]:
            assert isinstance(outcome.once, LineDown)
        assert all(o.at - gone < 0.002 for o in outcomes)
        after = line.submit(dev, dev.tags[0], 9)
        assert isinstance(after.once, LineDown)


@pytest.mark.parametrize("moment", [0.0, 0.003, 0.01, 0.03, 0.1, 0.5])
@on_virtual_time
async def test_a_cancelled_line_ends_every_write_once(moment: float) -> None:
    dev = device([make_tag("D0", write=WriteRule()), *words(10, 20)])
    line = plant([dev])
    async with running(line) as task:
        await asyncio.sleep(1.5)
        line.stations[0].mute = moment == 0.5
        outcomes = [line.submit(dev, dev.tags[0], value) for value in range(20)]
        await asyncio.sleep(moment)
        task.cancel()
        await asyncio.sleep(0.001)
        for outcome in outcomes:
            assert isinstance(outcome.once, WriteResult | GatewayError)
    sent = len(line.writes_sent())
    done = [o for o in outcomes if isinstance(o.once, WriteResult)]
    unclear = [o for o in outcomes if isinstance(o.once, Unclear)]
    assert len(done) + len(unclear) in (sent, sent + 1)  # the silence before it may have run
    assert all(isinstance(o.once, LineDown | Offline | WriteResult | Unclear) for o in outcomes)


@on_virtual_time
async def test_a_bit_write_keeps_the_other_bits_of_the_word() -> None:
    tags = [make_tag(f"D7.{bit}", write=WriteRule(verify=True), every=0.3) for bit in range(16)]
    line = plant([device(tags)])
    memory = line.stations[0].memory
    memory.write("D", 7, [0b1010_0101_1100_0011])
    async with running(line):
        await asyncio.sleep(0.5)
        for bit, value in ((3, True), (0, False), (15, False), (14, True), (3, True)):
            before = memory.read("D", 7)[0]
            outcome = line.submit(line.devices[0], tags[bit], value)
            await asyncio.sleep(0.5)
            expected = before | 1 << bit if value else before & ~(1 << bit)
            assert memory.read("D", 7)[0] == expected
            assert outcome.once.value is value
            assert outcome.once.verified


@on_virtual_time
async def test_a_written_value_is_read_before_the_next_poll_is_due() -> None:
    slow = make_tag("D0", write=WriteRule(), every=60.0)
    line = plant([device([slow])])
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], slow, 4711)
        await asyncio.sleep(0.2)
        assert outcome.once.value == 4711
        assert line.now[slow].value == 4711


@on_virtual_time
async def test_a_refused_write_reports_the_error_code() -> None:
    tag = make_tag("D0", write=WriteRule())
    line = plant([device([tag, *words(10, 2)])])
    async with running(line):
        await asyncio.sleep(1)
        line.stations[0].inner.memory.holes.add(("D", 0))
        outcome = line.submit(line.devices[0], tag, 1)
        await asyncio.sleep(0.5)
        assert isinstance(outcome.once, Refused)
        assert outcome.once.code == "28"


@on_virtual_time
async def test_a_waiting_write_ends_in_time_while_one_transaction_takes_long() -> None:
    """The engine's deadline wakes the line, though its transaction is still open."""
    slow = device(words(0, 1, every=1.0), reply_timeout=12.0)
    other = device([make_tag("D0", every=60.0, write=WriteRule())], station=2)
    line = plant([slow, other])
    async with running(line):
        await asyncio.sleep(3)
        line.stations[0].mute = True
        await asyncio.sleep(2)  # its poll waits for a reply
        outcome = line.submit(other, other.tags[0], 1)
        await asyncio.sleep(WRITE_EXPIRY + 0.1)
        assert isinstance(outcome.once, Busy)
        assert outcome.at - outcome.asked == pytest.approx(WRITE_EXPIRY, abs=0.01)
