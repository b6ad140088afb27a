"""The cheapest cover, against every cover there is."""

import itertools
import random
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.planning.coalesce import Request, SecondsOf, coalesce

Row = list[tuple[int, int]]  # first unit, units


def wire(row: Row, overhead: float, unit: float, limit: int, grain: int = 1) -> SecondsOf:
    """An exchange over a run of items: so much to ask, so much for each `grain` units."""

    def seconds(first: int, last: int) -> float | None:
        begin, end = row[first][0] // grain, -(-sum(row[last]) // grain)
        return None if end - begin > limit else overhead + unit * (end - begin)

    return seconds


def spent(requests: list[Request], seconds: SecondsOf) -> float:
    found = 0.0
    for request in requests:
        one = seconds(request.first, request.last)
        assert one is not None
        found += one / request.every
    return found


def check_served(requests: list[Request], intervals: list[float]) -> None:
    for item, interval in enumerate(intervals):
        assert any(r.first <= item <= r.last and r.every <= interval for r in requests), item


def brute_force(intervals: list[float], seconds: SecondsOf) -> float:
    """Every set of requests that are disjoint within an interval; the least cost that serves."""
    rates = sorted(set(intervals))
    n = len(intervals)

    def rows(at: int) -> list[list[tuple[int, int]]]:
        if at >= n:
            return [[]]
        found = rows(at + 1)
        return found + [
            [(at, last), *rest]
            for last in range(at, n)
            if seconds(at, last) is not None
            for rest in rows(last + 1)
        ]

    best = float("inf")
    for choice in itertools.product(rows(0), repeat=len(rates)):
        requests = [
            Request(first, last, every)
            for every, row in zip(rates, choice, strict=True)
            for first, last in row
        ]
        served = all(
            any(r.first <= i <= r.last and r.every <= interval for r in requests)
            for i, interval in enumerate(intervals)
        )
        if served:
            best = min(best, spent(requests, seconds))
    return best


@st.composite
def rows(draw: st.DrawFn) -> Row:
    at, row = 0, []
    for _ in range(draw(st.integers(1, 5))):
        at += draw(st.integers(0, 6))
        size = draw(st.integers(1, 3))
        row.append((at, size))
        at += size
    return row


@settings(max_examples=150)
@given(
    rows(),
    st.data(),
    st.floats(0.5, 8),
    st.integers(3, 20),
    st.sampled_from([1, 8]),
)
def test_no_set_of_requests_costs_less(
    row: Row, data: st.DataObject, overhead: float, limit: int, grain: int
) -> None:
    pick = st.sampled_from([1.0, 2.0, 10.0]) if len(row) < 5 else st.sampled_from([1.0, 3.0])
    intervals = [data.draw(pick) for _ in row]
    seconds = wire(row, overhead, 1.0, limit, grain)
    found = coalesce(intervals, seconds, even=grain == 1)
    check_served(found, intervals)
    assert spent(found, seconds) == pytest.approx(brute_force(intervals, seconds), rel=1e-9)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0, 4), st.sampled_from([0.5, 1.0, 5.0])), max_size=40))
def test_even_costs_give_the_same_result_faster(steps: list[tuple[int, float]]) -> None:
    row, at = [], 0
    for gap, _ in steps:
        row.append((at + gap, 1))
        at += gap + 1
    intervals = [every for _, every in steps]
    seconds = wire(row, 3, 1, 7)
    quick, slow = coalesce(intervals, seconds, even=True), coalesce(intervals, seconds)
    assert spent(quick, seconds) == pytest.approx(spent(slow, seconds))


def test_a_slower_item_joins_a_faster_request() -> None:
    row = [(0, 1), (1, 1), (2, 1)]
    found = coalesce([1.0, 10.0, 1.0], wire(row, 10, 1, 64))
    assert found == [Request(0, 2, 1.0)]


def test_a_slower_request_overlaps_a_faster_one() -> None:
    row = [(0, 20), (20, 1), (21, 20)]
    found = coalesce([100.0, 0.1, 100.0], wire(row, 10, 1, 64))
    assert sorted(found) == [Request(0, 2, 100.0), Request(1, 1, 0.1)]


def test_no_request_crosses_a_split() -> None:
    row = [(n, 1) for n in range(6)]
    found = coalesce([1.0] * 6, wire(row, 10, 1, 64), frozenset({2, 5}))
    assert found == [Request(0, 1, 1.0), Request(2, 4, 1.0), Request(5, 5, 1.0)]


def test_an_item_that_fits_no_request_is_named() -> None:
    with pytest.raises(ValueError, match="1"):
        coalesce([1.0, 1.0], wire([(0, 1), (1, 9)], 1, 1, 4))


def test_the_work_grows_with_the_number_of_items_not_with_its_square() -> None:
    def work(n: int) -> float:
        rng = random.Random(7)
        row, at = [], 0
        for _ in range(n):
            at += rng.choice([0, 0, 0, 1, 5, 40])
            row.append((at, rng.choice([1, 1, 2])))
            at += row[-1][1]
        intervals = [rng.choice([0.5, 1.0, 5.0]) for _ in range(n)]
        begun = time.process_time()
        coalesce(intervals, wire(row, 12, 1, 64), even=True)
        return time.process_time() - begun

    work(200)  # warm
    assert work(4000) < 40 * max(work(400), 1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_on_a_network_the_cheapest_states_are_enough(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a network, with many intervals: then not all ways are followed."""
    chance = random.Random(seed)
    row = [(unit, 1) for unit in sorted(chance.sample(range(300), 200))]
    intervals = [chance.choice((0.1, 0.5, 1.0, 2.0, 10.0, 60.0)) for _ in row]
    seconds = wire(row, 0.006, 2e-6, 125)
    found = coalesce(intervals, seconds, even=True)
    check_served(found, intervals)
    monkeypatch.setattr("gateway.planning.coalesce.MOST", 10**9)
    least = coalesce(intervals, seconds, even=True)
    assert spent(found, seconds) == pytest.approx(spent(least, seconds))
