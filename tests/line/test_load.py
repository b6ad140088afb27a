"""Polls on a loaded line: the order of blocks, the share of each device, the phases."""

import asyncio
import itertools

import pytest

from gateway.planning.wire_timing import WireTiming
from tests.line.clocks import clocks, wind_up
from tests.sim.plant import device, make_tag, plant, running, words
from tests.sim.virtual import now, on_virtual_time


@on_virtual_time
async def test_an_overloaded_line_is_always_busy_and_starves_no_block() -> None:
    devices = [
        device(
            [
                *words(0, 40, device=f"p{n}", every=0.1),
                *words(500, 10, device=f"p{n}", every=0.3),
                *words(1000, 60, device=f"p{n}", every=2.0),
            ],
            station=n,
            name=f"p{n}",
            learn_silence=False,  # it is counted below
        )
        for n in (1, 2, 3)
    ]
    load = sum(d.load for d in devices)
    assert load > 2
    line = plant(devices)
    async with running(line):
        await asyncio.sleep(2)
        start, busy, waits = (
            now(),
            line.line.engine.record.busy,
            line.line.engine.record.turnarounds,
        )
        exchanges = sum(d.record.exchanges for d in devices)
        await asyncio.sleep(300)
        spoken = line.line.engine.record.busy - busy + line.line.engine.record.turnarounds - waits
        quiet = 0.005 * (sum(d.record.exchanges for d in devices) - exchanges)
    assert (spoken + quiet) / 300 >= 0.98
    for dev in devices:
        assert dev.record.overruns > 100
        for block in dev.blocks:
            tag = block.tags[0]
            times = [at for at, s in line.reported if s.tag is tag and at >= start]
            cycle = sum(d.seconds(b.cost) for d in devices for b in d.blocks)
            ages = [b - a for a, b in itertools.pairwise(times)]
            assert max(ages) <= 2 * block.every + cycle


@on_virtual_time
async def test_a_late_poll_is_sent_once() -> None:
    slow, fast = clocks(5, station=1, every=0.5), clocks(5, station=2, every=0.5)
    line = plant([slow, fast])
    wind_up(line)
    async with running(line):
        await asyncio.sleep(5)
        line.stations[1].mute = True  # one time-out and one guard: a second in all
        await asyncio.sleep(0.6)
        line.stations[1].mute = False
        start = now()
        await asyncio.sleep(4.4)
        gaps = line.reads(slow, start)
        assert all(b - a > 0.3 for a, b in itertools.pairwise(gaps))
        assert slow.record.overruns >= 1


@on_virtual_time
async def test_at_115200_baud_a_block_is_read_every_20_ms() -> None:
    wire = WireTiming(115200, 10)
    dev = device(words(0, 20, every=0.02), wire=wire)
    line = plant([dev], wire=wire)
    async with running(line):
        await asyncio.sleep(5)
    assert len(line.reads(dev)) > 200


@on_virtual_time
async def test_devices_share_a_full_line_by_time_not_by_number_of_blocks() -> None:
    """One device has eight long blocks, the other three short ones: each gets half of the time."""
    greedy = device(
        [tag for n in range(8) for tag in words(n * 500, 60, every=0.2)], name="greedy", station=1
    )
    modest = device(
        [make_tag(f"D{n * 300}", every=0.02, device="modest") for n in range(3)],
        name="modest",
        station=2,
    )
    line = plant([greedy, modest])
    async with running(line):
        await asyncio.sleep(60)
        before = greedy.record.wire_time, modest.record.wire_time
        await asyncio.sleep(120)
    spent = [dev.record.wire_time - was for dev, was in zip((greedy, modest), before, strict=True)]
    # The silence before each request counts for the schedule and not in wire_time.
    assert 0.6 < spent[1] / spent[0] < 1.1, spent


@on_virtual_time
async def test_polls_are_spread_over_their_period_after_the_first_round() -> None:
    dev = device([make_tag(f"D{n * 300}", every=10.0) for n in range(8)])
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(45)
        dues = sorted(poll.due % 10 for poll in line.line.engine.schedule.polls(dev))
    gaps = [b - a for a, b in itertools.pairwise(dues)]
    assert sum(gap > 0.2 for gap in gaps) >= 6, dues


@on_virtual_time
async def test_the_turnaround_is_learned_in_spite_of_a_refused_address() -> None:
    tags = [make_tag(f"D{66 * n}", device="plc1", every=0.5) for n in range(10)]
    dev = device(tags, reply_timeout=0.5)
    line = plant([dev])
    line.stations[0].inner.memory.holes.add(("D", 66))
    async with running(line):
        await asyncio.sleep(20)
        line.stations[0].late = lambda _: 0.4
        await asyncio.sleep(120)
        assert dev.turnaround.expected == pytest.approx(0.405, abs=0.02)
        known = dev.record.overdue
        await asyncio.sleep(60)
        assert dev.record.overdue == known


@on_virtual_time
async def test_blocks_go_in_an_order_in_which_neighbours_differ_and_none_is_longer() -> None:
    """Two blocks of one shape, each read with more addresses, cost up to 8 % of the wire."""
    dev = device(
        [tag for n in range(12) for tag in words(40 * n, 1 + n // 4, every=0.05)],
        learn_silence=False,
    )
    assert [block.span.size for block in dev.blocks] == 4 * [1] + 4 * [2] + 4 * [3]
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(5)
        sent = len(line.bench.sent)
        await asyncio.sleep(30)
    bytes_read = [int(data[9:11], 16) for _, data in line.bench.sent[sent:]]
    assert len(bytes_read) > 700
    assert all(count not in bytes_read[n + 1 : n + 3] for n, count in enumerate(bytes_read))
    assert set(bytes_read) == {2, 4, 6}
    gaps = [b - a for a, b in itertools.pairwise(line.reads(dev, 5.0))]
    assert max(gaps) < 1.5 * sum(dev.seconds(block.cost) for block in dev.blocks)


@on_virtual_time
async def test_a_block_of_the_commonest_shape_is_not_overtaken_for_ever() -> None:
    """Nine blocks have one shape: the tenth, which differs from all, is no more often read."""
    dev = device([tag for n in range(10) for tag in words(40 * n, 1 + 4 * (n == 9), every=0.01)])
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(30)
    counts = [len(line.reads_of(block.tags[0], 5.0)) for block in dev.blocks]
    assert max(counts) < 1.1 * min(counts)
