"""A whole line on virtual time: late, mute, noisy and refusing stations, and ports that vanish."""

import asyncio
import itertools
import random
from typing import Any

import pytest
from structlog.testing import capture_logs

from gateway.engine.device import Device
from gateway.engine.health import State
from gateway.engine.requests import WRITE_EXPIRY
from gateway.errors import Busy, Evidence, GatewayError, LineDown, Offline, Refused, Unclear
from gateway.line.line import REOPEN_LONGEST
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.vigor import Vigor
from gateway.tags import Quality, Reason, Tag, WriteResult, WriteRule
from tests.sim.bench import WIRE
from tests.sim.plant import Plant, clockwork, device, make_tag, plant, running, words
from tests.sim.virtual import on_virtual_time
from tests.sim.witness import Witness


def now() -> float:
    return asyncio.get_running_loop().time()


def clocks(*sizes: int, station: int = 1, every: float = 0.5, **settings: Any) -> Device:
    """A device with blocks of these sizes, far apart."""
    name = f"plc{station}"
    tags: list[Tag] = []
    for number, size in enumerate(sizes):
        tags += words(1000 * number, size, device=name, every=every)
    return device(tags, station=station, name=name, **settings)


def wind_up(plant: Plant) -> None:
    for dev, station in zip(plant.devices, plant.stations, strict=True):
        clockwork(station.memory, [tag.address.number for tag in dev.tags])


# Late replies


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("sizes", [(10, 10, 10), (5, 9, 14)])
@pytest.mark.parametrize("most", [0.15, 1.2])  # seconds beyond the time-out; the guard is 0.3
@pytest.mark.parametrize("turnaround_known", [True, False])
@on_virtual_time
async def test_late_replies_never_make_a_wrong_value(
    share: float, sizes: tuple[int, ...], most: float, turnaround_known: bool
) -> None:
    timeout = 0.3

    def late(chance: random.Random) -> float:
        if chance.random() < share:
            return timeout + chance.uniform(0.05, most)
        return 0.0 if turnaround_known else chance.uniform(0.0, timeout / 2)

    devices = [
        clocks(*sizes, station=n, every=0.2, guard=0.3, reply_timeout=timeout) for n in (1, 2)
    ]
    line = plant(devices, seed=int(share * 100))
    wind_up(line)
    for station in line.stations:
        station.late = late
    witness = Witness(line)
    async with running(line):
        for _ in range(60):
            await asyncio.sleep(120)
            if witness.right >= 10_000:
                break
    assert witness.wrong == []
    assert witness.right >= 10_000
    assert sum(d.record.late for d in devices) > 20


@on_virtual_time
async def test_a_late_answer_within_the_guard_is_waited_for_and_counted() -> None:
    dev = clocks(10, reply_timeout=0.3, guard=0.5)
    line = plant([dev])
    wind_up(line)
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].late = lambda _: 0.4
        await asyncio.sleep(5)
        assert dev.record.late >= 3
        assert dev.state is State.OFFLINE
        assert "raise reply_timeout" in dev.diagnosis()
        await asyncio.sleep(60)
        assert "raise reply_timeout" in dev.diagnosis()  # probes do not wait for it any more


@pytest.mark.parametrize("late_acks", [0.1, 0.4])
@on_virtual_time
async def test_late_acknowledgements_never_prove_another_write(late_acks: float) -> None:
    """Done is what the memory holds; nothing is sent twice; a late answer proves nothing."""
    dev = device(
        [make_tag(f"D{n}", write=WriteRule(), every=0.5) for n in range(4)],
        reply_timeout=0.2,
        guard=0.15,
    )
    line = plant([dev])
    station = line.stations[0]
    said: list[int] = []

    def late(chance: random.Random) -> float:
        return 0.2 + chance.uniform(0.05, 0.3) if chance.random() < late_acks else 0.0

    def lose(value: int) -> None:
        station.inner.mute = value % 7 == 0  # it obeys, and nobody hears of it

    station.late = late
    async with running(line):
        await asyncio.sleep(1)
        for value in range(1, 1500):
            tag = dev.tags[value % 4]
            # Before each write somebody may deafen the station: then it is not done.
            deaf = value % 5 == 0
            hear = station.inner.hear
            if deaf:
                station.inner.hear = lambda data, now: []  # type: ignore[method-assign]
            outcome = line.submit(dev, tag, value)
            while not outcome.outcomes:
                await asyncio.sleep(0.01)
            station.inner.hear = hear  # type: ignore[method-assign]
            held = station.memory.read("D", tag.address.number)[0]
            match outcome.once:
                case WriteResult():
                    assert held == value
                    said.append(value)
                case Offline() | Busy():
                    assert held != value
                case Unclear():
                    pass
                case other:
                    raise AssertionError(other)
    sent = [data for _, data in line.writes_sent()]
    assert len(said) > 300
    assert len(sent) == len(set(sent))  # every write had its own value


# Silent stations


@on_virtual_time
async def test_a_mute_station_is_bad_within_two_intervals_and_good_within_a_probe() -> None:
    dev = clocks(10, 10, every=1.0)
    others = [clocks(10, station=n) for n in (2, 3)]
    line = plant([dev, *others])
    wind_up(line)
    async with running(line):
        for _ in range(6):
            await asyncio.sleep(7.3)
            muted, line.stations[0].mute = now(), True
            await asyncio.sleep(10)
            for tag in dev.tags:
                assert line.turned(tag, Quality.BAD, muted) - muted <= 2 * 1.0 + 0.5 + 0.1
            assert line.reason(dev.tags[0]) is Reason.NO_REPLY
            back, line.stations[0].mute = now(), False
            probes = len(line.stations[0].heard)
            await asyncio.sleep(65)
            first = line.stations[0].heard[probes][0]
            for tag in dev.tags:
                assert line.turned(tag, Quality.GOOD, back) - first < 1.0


@on_virtual_time
async def test_when_all_stations_die_at_once_all_values_turn_bad() -> None:
    devices = [clocks(10, station=n, every=1.0) for n in range(1, 21)]
    line = plant(devices)
    wind_up(line)
    async with running(line):
        await asyncio.sleep(10)
        for station in line.stations:
            station.mute = True
        muted = now()
        await asyncio.sleep(60)
        for dev in devices:
            assert line.turned(dev.tags[0], Quality.BAD, muted) - muted <= 2 * 1.0 + 1.0 + 0.6


@on_virtual_time
async def test_a_hiccup_of_one_station_does_not_spoil_the_others() -> None:
    devices = [clocks(10, station=n, every=0.2) for n in range(1, 4)]
    line = plant(devices)
    wind_up(line)
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].mute = True
        since = now()
        await asyncio.sleep(120)
    for dev in devices[1:]:
        assert all(
            s.quality is Quality.GOOD for at, s in line.told if at > since and s.tag is dev.tags[0]
        )


@pytest.mark.parametrize(("healthy", "mute"), [(4, 1), (1, 31)])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("first", [False, True])
@on_virtual_time
async def test_healthy_stations_keep_95_percent_of_their_reads(
    healthy: int, mute: int, full: bool, first: bool
) -> None:
    """After a settling time of two exchanges' time-outs for each mute station; and while the line
    settles, half of them."""
    every, span = (0.05, 120) if full else (1.0, 400)
    devices = [clocks(20, station=n, every=every) for n in range(1, healthy + mute + 1)]
    alive = devices[:healthy] if first else devices[mute:]

    async def reads(dead: bool) -> tuple[int, int, float]:
        fresh = [clocks(20, station=n, every=every) for n in range(1, healthy + mute + 1)]
        line = plant(fresh if dead else [d for d in fresh if d.name in [a.name for a in alive]])
        wind_up(line)
        for dev, station in zip(line.devices, line.stations, strict=True):
            station.mute = dev.name not in [a.name for a in alive]
        async with running(line):
            await asyncio.sleep(2)
            start = now()
            await asyncio.sleep(2 * mute)
            settled = now()
            await asyncio.sleep(span)
        ok = [d for d in line.devices if d.name in [a.name for a in alive]]
        probed = sum(
            len(data) * WIRE.character + 0.5
            for at, data in line.bench.sent
            if at >= settled and int(data[1:3], 16) not in [d.driver.station for d in ok]
        )
        settling = sum(sum(at < settled for at in line.reads(d, start)) for d in ok)
        return settling, sum(len(line.reads(d, settled)) for d in ok), probed / span

    with_mute, kept, probing = await reads(dead=True)
    without, best, _ = await reads(dead=False)
    assert kept >= 0.95 * best
    assert probing <= 0.05
    if first or mute == 1:
        assert with_mute >= (0.3 if full else 0.8) * without


@on_virtual_time
async def test_silent_stations_are_probed_on_a_full_line_too() -> None:
    devices = [clocks(60, 60, station=n, every=0.05) for n in (1, 2)]
    line = plant(devices)
    wind_up(line)
    line.stations[1].mute = True
    async with running(line):
        await asyncio.sleep(30)
        assert not line.good(devices[1])
        line.stations[1].mute = False
        await asyncio.sleep(30)
        assert line.good(devices[1])


@on_virtual_time
async def test_writes_to_a_silent_station_do_not_take_the_line() -> None:
    devices = [
        device([make_tag("D0", write=WriteRule(), device=f"p{n}")], station=n) for n in (1, 2)
    ]
    line = plant(devices)
    line.stations[1].mute = True
    async with running(line):
        await asyncio.sleep(5)
        start = now()
        outcomes = []
        for value in range(600):
            outcomes.append(line.submit(devices[1], devices[1].tags[0], value))
            await asyncio.sleep(0.1)
        probes = [at for at, data in line.bench.sent if at >= start and data[1:3] == b"02"]
        assert len(probes) * 0.5 <= 0.06 * 60
        await asyncio.sleep(WRITE_EXPIRY)
        assert all(isinstance(o.once, Offline) for o in outcomes)
        assert line.writes_sent() == []
        assert len(line.reads(devices[0], start)) >= 57


@on_virtual_time
async def test_a_block_that_is_never_answered_does_not_take_the_line() -> None:
    """The station answers otherwise, so it is not silent: only this block is asked ever less."""
    odd, other = clocks(3, 40, station=1, every=0.5), clocks(10, station=2, every=0.2)
    line = plant([odd, other])
    wind_up(line)
    hear = line.stations[0].inner.hear
    line.stations[0].inner.hear = (  # type: ignore[method-assign]
        lambda data, now: [] if data[9:11] == b"50" else hear(data, now)  # 80 bytes
    )
    async with running(line):
        await asyncio.sleep(60)
        start = now()
        await asyncio.sleep(600)
        assert line.now[odd.tags[3]].reason is Reason.NO_REPLY
        assert line.now[odd.tags[0]].quality is Quality.GOOD
        assert len(line.reads(other, start)) >= 0.95 * 600 / 0.2
        line.stations[0].inner.hear = hear  # type: ignore[method-assign]
        await asyncio.sleep(65)
        assert line.good(odd)


# Writes


@on_virtual_time
async def test_under_full_load_a_write_waits_for_one_exchange_or_two() -> None:
    dev = device(
        [
            *words(0, 50, every=0.02),
            *words(500, 50, every=0.02),
            make_tag("D100", write=WriteRule()),
        ]
    )
    line = plant([dev])
    longest = max(dev.seconds(block.cost) for block in dev.blocks)
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
            times = [at for at, s in line.told if s.tag is tag and start <= at]
            assert max(b - a for a, b in itertools.pairwise(times)) < 1.5


@on_virtual_time
async def test_an_expired_write_is_never_sent() -> None:
    """Fifty writes wait behind a station that loses every acknowledgement."""
    dev = device([make_tag("D0", write=WriteRule(), every=10.0)])
    line = plant([dev])
    station = line.stations[0]
    async with running(line):
        await asyncio.sleep(1)
        # Private: the station decides this between two frames.
        answer = station.inner._answer
        station.inner._answer = (  # type: ignore[method-assign]
            lambda request, now: None if request[3:5] == b"61" else answer(request, now)
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
async def test_when_the_port_goes_a_write_in_flight_is_unclear_and_those_waiting_fail_at_once() -> (
    None
):
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
async def test_a_cancelled_line_answers_every_write_once(moment: float) -> None:
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
async def test_a_bit_of_a_word_is_changed_where_it_is() -> None:
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
async def test_a_written_value_is_seen_at_once() -> None:
    slow = make_tag("D0", write=WriteRule(), every=60.0)
    line = plant([device([slow])])
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], slow, 4711)
        await asyncio.sleep(0.2)
        assert outcome.once.value == 4711
        assert line.now[slow].value == 4711


@on_virtual_time
async def test_a_refused_write_says_the_makers_code() -> None:
    tag = make_tag("D0", write=WriteRule())
    line = plant([device([tag, *words(10, 2)])])
    async with running(line):
        await asyncio.sleep(1)
        line.stations[0].inner.holes.add(("D", 0))
        outcome = line.submit(line.devices[0], tag, 1)
        await asyncio.sleep(0.5)
        assert isinstance(outcome.once, Refused)
        assert outcome.once.code == "28"


# More asked for than the line carries


@on_virtual_time
async def test_an_overloaded_line_is_busy_all_the_time_and_starves_nobody() -> None:
    devices = [
        device(
            [
                *words(0, 40, device=f"p{n}", every=0.1),
                *words(500, 10, device=f"p{n}", every=0.3),
                *words(1000, 60, device=f"p{n}", every=2.0),
            ],
            station=n,
            name=f"p{n}",
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
            times = [at for at, s in line.told if s.tag is tag and at >= start]
            cycle = sum(d.seconds(b.cost) for d in devices for b in d.blocks)
            ages = [b - a for a, b in itertools.pairwise(times)]
            assert max(ages) <= 2 * block.every + cycle


@on_virtual_time
async def test_a_late_poll_is_done_once() -> None:
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


# Ports


@on_virtual_time
async def test_a_port_that_vanishes_turns_every_tag_and_comes_back() -> None:
    devices = [clocks(10, 10, station=n) for n in (1, 2)]
    line = plant(devices)
    wind_up(line)
    chance = random.Random(3)
    async with running(line):
        for _ in range(20):
            await asyncio.sleep(11 + chance.random())
            gone = now()
            line.bench.vanish()
            await asyncio.sleep(0.001)
            for dev in devices:
                for tag in dev.tags:
                    assert line.reason(tag) is Reason.LINE_DOWN
            assert line.turned(devices[0].tags[0], Quality.BAD, gone) - gone < 0.001
            line.bench.come_back()
            await asyncio.sleep(2)
            assert all(line.good(dev) for dev in devices)


@on_virtual_time
async def test_a_port_lost_in_the_quiet_after_a_time_out_is_told_at_once() -> None:
    dev = clocks(10, guard=20.0)
    line = plant([dev])
    async with running(line):
        await asyncio.sleep(2)
        line.stations[0].mute = True
        await asyncio.sleep(3)  # in the guard now
        line.bench.vanish()
        await asyncio.sleep(0.001)
        assert line.reason(dev.tags[0]) is Reason.LINE_DOWN


@on_virtual_time
async def test_the_pause_between_tries_grows_to_ten_seconds_and_starts_anew() -> None:
    line = plant([clocks(10)])
    async with running(line):
        await asyncio.sleep(60)
        for _ in range(2):
            line.bench.opened.clear()
            line.bench.vanish()
            await asyncio.sleep(300)
            tries = line.bench.opened
            pauses = [b - a for a, b in itertools.pairwise(tries)]
            assert 0.15 < pauses[0] < 0.5
            assert all(0.8 * 10 <= pause <= 1.2 * 10 + 0.01 for pause in pauses[8:])
            assert len({round(pause, 6) for pause in pauses[8:]}) > 5  # jitter
            line.bench.come_back()
            await asyncio.sleep(REOPEN_LONGEST * 3)
            assert line.line.engine.is_open


@on_virtual_time
async def test_a_port_that_stays_away_is_told_once_and_not_at_every_try() -> None:
    line = plant([clocks(5)])
    with capture_logs() as logs:
        async with running(line):
            await asyncio.sleep(10)
            for _ in range(2):
                line.bench.vanish()
                await asyncio.sleep(300)
                line.bench.come_back()
                await asyncio.sleep(REOPEN_LONGEST * 3)
    down = [entry["why"] for entry in logs if entry["event"] == "line down"]
    told = [e["why"] for e in logs if e["event"] == "line down" and e["log_level"] == "warning"]
    assert len(down) > 40
    assert told == ["unplugged", "unplugged"]  # once for each time it went


@on_virtual_time
async def test_a_bug_in_a_driver_takes_its_line_down_and_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken, sound = plant([clocks(10)]), plant([clocks(10)])
    read, bugs = Vigor.read, 3

    async def buggy(self: Vigor, talk: Any, span: Any) -> Any:
        nonlocal bugs
        if self is broken.devices[0].driver and bugs:
            bugs -= 1
            raise ZeroDivisionError("a bug")
        return await read(self, talk, span)

    monkeypatch.setattr(Vigor, "read", buggy)
    async with running(broken), running(sound):
        await asyncio.sleep(0.3)
        assert "ZeroDivisionError" in broken.line.engine.record.trouble
        assert broken.reason(broken.devices[0].tags[0]) is Reason.LINE_DOWN
        await asyncio.sleep(10)
        assert broken.good(broken.devices[0])
        assert sound.line.engine.record.opened == 1


@on_virtual_time
async def test_a_bug_in_the_middle_of_a_write_answers_it(monkeypatch: pytest.MonkeyPatch) -> None:
    tag = make_tag("D0", write=WriteRule())
    line = plant([device([tag])])

    async def buggy(self: Vigor, talk: Any, span: Any, units: Any) -> bool:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Vigor, "write", buggy)
    async with running(line):
        await asyncio.sleep(1)
        outcome = line.submit(line.devices[0], tag, 1)
        await asyncio.sleep(5)
        assert isinstance(outcome.once, Unclear)
        assert line.good(line.devices[0])


# Refused addresses


@on_virtual_time
async def test_a_refused_address_is_found_and_the_rest_is_good_within_a_second() -> None:
    dev = device(words(0, 60))
    line = plant([dev])
    station = line.stations[0].inner
    station.holes = {("D", 23), ("D", 24), ("D", 59)}
    start = now()
    bad = [dev.tags[n] for n in (23, 24, 59)]
    async with running(line):
        await asyncio.sleep(2)
        for tag in dev.tags:
            if tag in bad:
                assert line.reason(tag) is Reason.REFUSED
            else:
                assert line.turned(tag, Quality.GOOD, start) - start < 1.5
        assert [b.span.size for b in dev.blocks] == [23, 1, 1, 34, 1]
        await asyncio.sleep(10)
        settled, refused = now(), dev.record.refusals["28"]
        await asyncio.sleep(280)
        assert dev.record.refusals["28"] == refused + 2 * len(bad)  # after 10 s, after a minute
        station.holes = {("D", 59)}
        await asyncio.sleep(100)
        assert line.now[bad[0]].quality is Quality.GOOD
        assert line.now[bad[1]].quality is Quality.GOOD
        assert [b.span.size for b in dev.blocks] == [59, 1]
        assert dev.record.refusals["28"] - refused <= 2 * len(bad) + 4
        assert len(line.reads(dev, settled)) >= 375


@on_virtual_time
async def test_a_refusal_of_a_moment_costs_seconds_not_minutes() -> None:
    dev = device(words(0, 20))
    line = plant([dev])
    station = line.stations[0].inner
    async with running(line):
        await asyncio.sleep(5.5)
        station.holes = {("D", n) for n in range(5)}  # its program is being loaded, say
        await asyncio.sleep(1.5)
        station.holes = set()
        await asyncio.sleep(5)
        assert line.good(dev)
        await asyncio.sleep(5)
        assert [b.span.size for b in dev.blocks] == [20]


# Noise


@pytest.mark.parametrize(("noise", "silent"), [(1e-4, False), (1e-3, False), (1e-2, True)])
@on_virtual_time
async def test_noise_makes_no_wrong_value_and_no_exception(noise: float, silent: bool) -> None:
    """One turned bit is always seen by the sum; two in a frame are missed once in many."""
    devices = [clocks(20, 8, station=n, every=0.2, reply_timeout=0.2, guard=0.2) for n in (1, 2)]
    line = plant(devices, seed=7)
    wind_up(line)
    witness = Witness(line)
    line.bench.noise = noise
    async with running(line):
        await asyncio.sleep(300)
        assert line.bench.damaged > 10
        assert line.line.engine.record.opened == 1
        line.bench.noise = 0.0
        await asyncio.sleep(70)
        assert all(line.good(dev) for dev in devices)
        # Words: two bits that cancel in one reply; theory and measurement: docs/residual-errors.md.
        blind = {1e-4: 0, 1e-3: 6, 1e-2: 40}[noise]
    assert len(witness.wrong) <= blind
    assert witness.right > 1000


# Echo


@on_virtual_time
async def test_an_echo_is_dropped() -> None:
    dev = clocks(10, 5)
    line = plant([dev], echo=True)
    wind_up(line)
    witness = Witness(line)
    async with running(line):
        await asyncio.sleep(20)
    assert witness.wrong == []
    assert witness.right > 500
    assert not dev.record.failures


@on_virtual_time
async def test_what_the_adapter_adds_before_the_echo_does_no_harm() -> None:
    dev = clocks(10, 5)
    line = plant([dev], echo=True, before_echo=b"\x00")
    wind_up(line)
    async with running(line):
        await asyncio.sleep(20)
        assert not dev.record.failures
        line.stations[0].mute = True
        await asyncio.sleep(20)
        assert dev.record.failures[Evidence.SILENCE] > 2


@on_virtual_time
async def test_above_19200_baud_the_clock_is_watched() -> None:
    wire = WireTiming(115200, 10)
    dev = device(words(0, 20, every=0.02), wire=wire)
    line = plant([dev], wire=wire)
    async with running(line):
        await asyncio.sleep(5)
    assert len(line.reads(dev)) > 200


@on_virtual_time
async def test_on_a_full_line_devices_share_the_wire_by_time_not_by_number_of_blocks() -> None:
    """One asks for eight long blocks, the other for one short one: both get half of the time."""
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
