"""The figures of `check`, compared with sums by hand over the frames in the Vigor manual.

On the line: 10 bits a character at 19200 baud (7E1), 5 ms of quiet before a request, and a station
that takes 5 ms to answer.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.engine.device.device import Device
from gateway.engine.device.reply_shapes import MARK_LONGEST
from gateway.engine.forecast import LineForecast, dark_for, forecast
from gateway.parts.transfers.forecast import forecasts
from gateway.planning.planner import shortest_round
from gateway.planning.wire_timing import WireTiming
from gateway.tags import Tag
from tests.e2e.processes import vigor_line, write_config
from tests.sim.plant import device, words
from tests.vectors import vectors

LENGTH = {vector.id: len(vector.frame) for vector in vectors("vigor")}
READ_D1_D2 = LENGTH["vigor-003"] + LENGTH["vigor-004"]
READ_M8_M15 = LENGTH["vigor-014"] + LENGTH["vigor-015"]
WRITE_D1 = LENGTH["vigor-007"] + LENGTH["vigor-006"]
FORCE_M10 = LENGTH["vigor-008"] + LENGTH["vigor-009"]
TWO_WORDS = {"a": {"address": "D1"}, "b": {"address": "D2"}}


def seconds_of(characters: int) -> float:
    return 0.005 + characters * 10 / 19200 + 0.005


def forecast_of(folder: Path, tags: dict[str, Any], **settings: Any) -> LineForecast:
    line = vigor_line("simulator", tags, **{"turnaround": "5ms", **settings})
    path = write_config(
        folder / "c.yaml", "tcp/127.0.0.1:7447", {"hall": line}, defaults={"every": "1s"}
    )
    [found] = forecasts(load(path))
    return found


def test_one_block_of_two_words(tmp_path: Path) -> None:
    line = forecast_of(tmp_path, TWO_WORDS)
    [block] = line.blocks
    assert tuple(block.block.cost) == (LENGTH["vigor-003"], LENGTH["vigor-004"])
    assert block.seconds == pytest.approx(seconds_of(READ_D1_D2))
    mark = seconds_of(READ_D1_D2) / MARK_LONGEST
    assert line.load == pytest.approx(seconds_of(READ_D1_D2) + mark)
    assert line.cycle == pytest.approx(seconds_of(READ_D1_D2))
    assert (line.requests, line.characters) == (1, READ_D1_D2)
    assert not line.overloaded
    assert line.advice() == ""


def test_the_load_counts_each_interval(tmp_path: Path) -> None:
    tags = {"d": {"address": "D1", "every": "250ms"}, "m": {"address": "M8", "every": "2s"}}
    tags["e"] = {"address": "D2", "every": "250ms"}
    line = forecast_of(tmp_path, tags)
    words, bits = seconds_of(READ_D1_D2), seconds_of(READ_M8_M15)
    assert line.load == pytest.approx(4 * words + bits / 2 + bits / MARK_LONGEST)
    assert line.requests == pytest.approx(4.5)
    assert line.characters == pytest.approx(4 * READ_D1_D2 + READ_M8_M15 / 2)
    assert line.cycle == pytest.approx(words + bits)


def test_the_worst_age_is_an_interval_the_longest_wait_and_the_exchange(tmp_path: Path) -> None:
    """At worst both polls come due just as the longer exchange has begun: three in a row."""
    tags = {**TWO_WORDS, "m": {"address": "M8"}}
    line = forecast_of(tmp_path, tags)
    words, bits = seconds_of(READ_D1_D2), seconds_of(READ_M8_M15)
    wait = words + words + bits
    ages = {row.block.tags[0].text: row.worst_age for row in line.blocks}
    assert ages == {"D1": pytest.approx(1 + wait + words), "M8": pytest.approx(1 + wait + bits)}


@pytest.mark.parametrize(
    ("address", "rule", "exchanges"),
    [
        ("D1", True, [WRITE_D1]),
        ("M10", True, [FORCE_M10]),
        ("D1", {"verify": True}, [WRITE_D1, LENGTH["vigor-012"] + LENGTH["vigor-002"]]),
        ("D1.3", True, [LENGTH["vigor-012"] + LENGTH["vigor-002"], WRITE_D1]),
    ],
)
def test_a_write_waits_for_the_exchange_before_it(
    tmp_path: Path, address: str, rule: Any, exchanges: list[int]
) -> None:
    line = forecast_of(tmp_path, {"w": {"address": address, "write": rule}})
    [read] = line.blocks
    assert line.worst_write == pytest.approx(read.seconds + sum(map(seconds_of, exchanges)))


def test_an_offline_station_costs_its_time_out_and_its_late_guard(tmp_path: Path) -> None:
    tags = {"w": {"address": "D1", "write": True}}
    line = forecast_of(tmp_path, tags, reply_timeout="200ms", late_guard="1s")
    assert line.worst_write_silent == pytest.approx(line.worst_write + 0.2 + 1.0)


def test_on_an_overloaded_line_every_interval_is_stretched(tmp_path: Path) -> None:
    tags = {name: {**tag, "every": "20ms"} for name, tag in TWO_WORDS.items()}
    line = forecast_of(tmp_path, tags)
    words = seconds_of(READ_D1_D2)
    assert line.load == pytest.approx(words / 0.02, rel=1e-4)
    assert line.overloaded
    assert line.blocks[0].worst_age == pytest.approx(2 * 0.02 + words + words)
    assert line.advice() == (
        "line hall is asked for 133% of what it can carry at 19200 baud: multiply the intervals "
        "by 1.33, or poll all tags every 0.03 s, the shortest interval for all"
    )


def test_the_advised_intervals_fit(tmp_path: Path) -> None:
    tags = {f"d{i}": {"address": f"D{200 * i}", "every": "50ms"} for i in range(20)}
    line = forecast_of(tmp_path, tags)
    assert line.overloaded
    longer = {name: {**tag, "every": f"{line.cycle + 0.01:.2f}s"} for name, tag in tags.items()}
    assert not forecast_of(tmp_path, longer).overloaded
    stretched = {name: {**t, "every": f"{50 * line.load + 1:.0f}ms"} for name, t in tags.items()}
    assert not forecast_of(tmp_path, stretched).overloaded


def test_a_slower_line_takes_longer(tmp_path: Path) -> None:
    """8E1 is 11 bits a character."""
    path = write_config(
        tmp_path / "c.yaml",
        "tcp/127.0.0.1:7447",
        {
            "hall": {
                **vigor_line("simulator", TWO_WORDS, format="8E1"),
                "baudrate": 9600,
                "format": "8E1",
            }
        },
    )
    [line] = forecasts(load(path))
    assert line.cycle == pytest.approx(0.005 + READ_D1_D2 * 11 / 9600 + 0.005)


def test_a_disabled_device_costs_nothing(tmp_path: Path) -> None:
    line = forecast_of(tmp_path, TWO_WORDS, enabled=False)
    assert (line.blocks, line.load, line.cycle, line.worst_write) == ((), 0, 0, 0)


def test_a_line_that_is_exactly_full_is_not_overloaded(tmp_path: Path) -> None:
    path = write_config(
        tmp_path / "c.yaml", "tcp/127.0.0.1:7447", {"hall": vigor_line("simulator", TWO_WORDS)}
    )
    config = load(path)
    [section] = config.lines
    device = Device(section.devices[0], section.wire)
    [block] = device.blocks
    device.blocks = (replace(block, every=device.seconds(block.cost)),)
    line = forecast("hall", [device], section.wire)
    assert line.load == pytest.approx(1, rel=1e-4)
    assert not math.isinf(line.blocks[0].worst_age)


def test_a_returned_station_is_seen_after_a_pause_and_one_round_of_probes() -> None:
    """32 stations at 9600 baud, as in `benchmarks/returns.py`, asked every 10 s."""
    wire = WireTiming(9600, 10)
    tags = words(0, 20, every=10.0)
    devices = [device(tags, station=n, wire=wire) for n in range(1, 33)]
    found = forecast("line", devices, wire)
    short = 0.005 + 50 / 960 + 0.05
    patient = 0.005 + 50 / 960 + 0.5
    one_round = 31 * (15 * short + patient) / 16 / (1 - found.load / 32)
    longest = max(block.seconds for block in found.blocks)
    assert found.seen_within == pytest.approx(1.1 * 4.0 + longest + one_round)
    assert found.seen_at_worst == pytest.approx(found.seen_within)
    assert found.seen_within < 10.0


def test_on_an_overloaded_line_it_is_seen_later() -> None:
    devices = [device(words(0, 60, every=0.5), station=n) for n in range(1, 9)]
    found = forecast("line", devices, devices[0].wire)
    assert found.overloaded
    assert found.seen_at_worst > 2 * found.seen_within


@pytest.mark.parametrize(
    ("intervals", "plans"), [((0.001, 0.001), 0), ((0.001, 0.002), 1), ((60.0, 30.0), 0)]
)
def test_a_round_is_planned_only_where_it_can_differ(
    intervals: tuple[float, float], plans: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On an overloaded line, for a device with several intervals."""
    made: list[object] = []

    def counted(tags: Sequence[Tag], *rest: Any) -> float:
        made.append(tags)
        return shortest_round(tags, *rest)

    monkeypatch.setattr("gateway.engine.forecast.shortest_round", counted)
    tags = [*words(0, 5, every=intervals[0]), *words(200, 5, every=intervals[1])]
    line = forecast("hall", [device(tags)], WireTiming(9600, 10))
    assert len(made) == plans
    if line.overloaded:
        one = device([replace(tag, every=1.0) for tag in tags])
        assert line.shortest == pytest.approx(sum(one.seconds(block.cost) for block in one.blocks))


def test_a_search_for_a_silent_address_takes_time_outs_for_each_half() -> None:
    """The line's other polls take their share of the time. A full line has none left."""
    one, many = device(words(0, 1)), device(words(0, 60))
    found = {dev: dark_for(dev, 0.0) for dev in (one, many)}
    reads = (found[many] or 0.0) - (found[one] or 0.0)
    halves = 6 * 3  # each alone, once longer, and again
    assert halves * many.longest_reply < reads < halves * (many.longest_reply + 0.3)
    assert dark_for(many, 0.5) == 2 * (found[many] or 0.0)
    assert dark_for(many, 1.0) is None
