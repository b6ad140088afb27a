"""Equal rows of addresses are planned once, and every plan is as if it were made alone."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.planning import area_items, planner
from gateway.planning.coalesce import coalesce
from gateway.planning.planner import Block, plan, shortest_round
from gateway.planning.wire_timing import Transactions, WireTiming
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.driver import AnyDriver, Span, Unit
from gateway.protocols.modbus import ModbusRtu, ModbusTcp
from gateway.protocols.models import model_of
from gateway.protocols.vigor import Vigor
from gateway.tags import Tag
from tests.sim.plant import make_tag

WIRE = WireTiming(19200, 10)
DRIVERS: list[Any] = [
    Vigor(station=1),
    ComputerLink(station=1),
    ComputerLink(station=1, profile="fx", frame_format=4, sum_check=False),
    ModbusRtu(station=1),
    ModbusRtu(station=1, max_read_words=10, addressing="vigor"),
    ModbusRtu(station=1, addressing="k120s"),
    ModbusTcp(station=1),
]


def seconds(driver: AnyDriver, turnaround: float | None = 0.01) -> Transactions:
    return Transactions(WIRE, driver.timing, turnaround)


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """The lengths of all rows that were planned, not remembered."""
    lengths: list[int] = []

    def counted(every: Any, *rest: Any, **named: Any) -> Any:
        lengths.append(len(every))
        return coalesce(every, *rest, **named)

    monkeypatch.setattr(area_items, "coalesce", counted)
    area_items._remembered.cache_clear()  # it has no other reader
    area_items._last_few.cache_clear()  # it has no other reader
    yield lengths
    area_items._remembered.cache_clear()
    area_items._last_few.cache_clear()


def row(letter: str, begin: int, step: int = 2, count: int = 20) -> list[Tag]:
    rates = (1.0, 5.0, 30.0)
    numbers = range(begin, begin + step * count, step)
    return [make_tag(f"{letter}{n}", every=rates[i % 3]) for i, n in enumerate(numbers)]


def test_a_large_plant_of_equal_devices_plans_one_row(planned: list[int]) -> None:
    tags = row("D", 0)
    for station in range(1, 65):
        driver = Vigor(station=station)
        plan(tags, driver, seconds(driver))
    assert planned == [20]


def test_words_at_other_addresses_are_the_same_row(planned: list[int]) -> None:
    first = plan(row("D", 0), DRIVERS[0], seconds(DRIVERS[0]))
    later = plan(row("D", 4000), DRIVERS[0], seconds(DRIVERS[0]))
    assert [block.span.start + 4000 for block in first] == [block.span.start for block in later]
    assert planned == [20]


def test_bits_at_other_addresses_are_another_row(planned: list[int]) -> None:
    """They are read in eights: a run costs more where it crosses a multiple of eight."""
    tags = [row("M", begin, step=7, count=12) for begin in (0, 8, 13)]
    for some in tags:
        plan(some, DRIVERS[0], seconds(DRIVERS[0]))
    assert planned == [12, 12, 12]


@pytest.mark.parametrize(
    "other",
    [
        {"turnaround": 0.02},
        {"cuts": frozenset({("D", 7)})},
        {"driver": ComputerLink(station=1)},
        {"wire": WireTiming(9600, 10)},
        {"tags": row("D", 0, step=3)},
        {"tags": [make_tag(tag.text, every=1.0) for tag in row("D", 0)]},
    ],
    ids=lambda other: next(iter(other)),
)
def test_a_row_that_costs_otherwise_is_planned_anew(
    other: dict[str, Any], planned: list[int]
) -> None:
    usual: dict[str, Any] = {
        "tags": row("D", 0),
        "driver": Vigor(),
        "wire": WIRE,
        "turnaround": 0.01,
        "cuts": (),
    }
    for found in (usual, usual | other):
        driver = found["driver"]
        time = Transactions(found["wire"], driver.timing, found["turnaround"])
        plan(found["tags"], driver, time, frozenset(found["cuts"]))
    assert len(planned) == 2


def test_of_long_rows_the_last_few_are_kept(planned: list[int]) -> None:
    def planned_again(length: int) -> int:
        before = len(planned)
        plan(row("D", 0, step=1, count=length), DRIVERS[0], seconds(DRIVERS[0]))
        return len(planned) - before

    longer = [area_items.LONGEST_KEPT + more for more in range(1, 6)]
    assert [planned_again(length) for length in longer] == [1] * 5
    assert [planned_again(length) for length in (longer[-1], longer[0])] == [0, 1]


@pytest.mark.parametrize("driver", DRIVERS, ids=repr)
def test_a_read_of_words_costs_the_same_at_every_address(driver: AnyDriver) -> None:
    """The rule of `Driver.cost` that makes rows at other addresses equal."""
    for area in driver.areas.values():
        if area.unit is Unit.BIT:
            continue
        for size in (1, 2, 5, 10, 11, 64, 65, 125, 126):
            last = area.last - size + 1
            if last < area.first:
                continue
            places = {area.first, last, (area.first + last) // 2, min(last, area.first + 7)}
            costs = {driver.cost(Span(area.name, place, size)) for place in places}
            assert len(costs) == 1, (area, size, costs)


addresses = st.one_of(
    st.builds("D{}".format, st.integers(0, 200)),
    st.builds("M{}".format, st.integers(0, 400)),
    st.builds("C{}".format, st.integers(200, 255)),
)


@settings(max_examples=60)
@given(
    st.lists(st.tuples(addresses, st.sampled_from([0.2, 1.0, 10.0])), max_size=30),
    st.lists(st.tuples(st.sampled_from([0, 0, 8, 100]), st.integers(1, 3)), max_size=5),
    st.frozensets(st.tuples(st.sampled_from(["D", "M"]), st.integers(0, 300)), max_size=3),
)
def test_a_remembered_plan_is_that_of_a_device_alone(
    drawn: list[tuple[str, float]], others: list[tuple[int, int]], cuts: planner.Cuts
) -> None:
    """`others`: devices planned before, with the same tags at addresses that lie higher."""
    for shift, station in others:
        driver = Vigor(station=station)
        plan([moved(text, every, shift) for text, every in drawn], driver, seconds(driver))
    tags = [moved(text, every, 0) for text, every in drawn]
    driver = Vigor(station=9)
    found = plan(tags, driver, seconds(driver), cuts)
    # A plain function is equal to no other: nothing is remembered for it.
    alone = plan(tags, driver, partial(seconds(driver)), cuts)
    assert [shown(block) for block in found] == [shown(block) for block in alone]


def moved(text: str, every: float, by: int) -> Tag:
    number = int(text[1:])
    by = 0 if text[0] == "C" else by
    return make_tag(f"{text[0]}{number + by}", every=every)


def shown(block: Block) -> tuple[Any, ...]:
    return block.span, block.every, block.cost, [tag.text for tag in block.tags]


def test_one_round_is_planned_for_one_interval() -> None:
    tags, driver = row("D", 0, step=9), DRIVERS[0]
    alike = [make_tag(tag.text, every=1.0) for tag in tags]
    blocks = plan(alike, driver, seconds(driver))
    assert shortest_round(tags, driver, seconds(driver)) == pytest.approx(
        sum(seconds(driver)(block.cost) for block in blocks)
    )


# -- models ----------------------------------------------------------------------------------


def test_a_model_is_all_settings_but_the_station_number() -> None:
    assert model_of(Vigor(station=1)) == model_of(Vigor(station=7))
    assert model_of(ModbusRtu(station=1)) == model_of(ModbusRtu(station=7))
    assert model_of(ModbusRtu(station=1)) != model_of(ModbusTcp(station=1))
    assert model_of(ModbusRtu(station=1)) != model_of(ModbusRtu(station=1, max_read_words=8))
    assert model_of(ComputerLink(station=1)) != model_of(ComputerLink(station=1, frame_format=4))


def test_a_broadcast_is_a_model_of_its_own() -> None:
    """Its areas can only be written."""
    assert model_of(ModbusRtu(station=0)) != model_of(ModbusRtu(station=1))


@pytest.mark.parametrize("driver", DRIVERS, ids=repr)
def test_drivers_of_one_model_have_the_same_costs(driver: Any) -> None:
    other = replace(driver, station=3)
    assert model_of(other) == model_of(driver)
    for area in driver.areas.values():
        for start in (area.first, area.first + 3):
            for size in (1, 3, 16, 40):
                span = Span(area.name, start, size)
                assert other.cost(span) == driver.cost(span)
                assert other.write_cost(span) == driver.write_cost(span)
