"""The planner asks for every tag once, keeps its cuts, and no cover of one interval is cheaper."""

import itertools
import time
from collections.abc import Iterator, Sequence
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import peers_requests
from gateway.errors import ConfigError
from gateway.planning.planner import Block, Cuts, plan
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Cost, Span
from gateway.protocols.modbus import ModbusRtu
from gateway.protocols.vigor import Vigor
from gateway.tags import Quality, Reason, Tag
from tests.sim.plant import make_tag

DRIVER = Vigor()


def at(baud: int, turnaround: float = 0.01) -> partial[float]:
    return partial(WireTiming(baud, 10).transaction, timing=DRIVER.timing, turnaround=turnaround)


def spans(blocks: Sequence[Block]) -> list[tuple[int, int]]:
    return [(block.span.start, block.span.size) for block in blocks]


def total(blocks: Sequence[Block], seconds: partial[float]) -> float:
    return sum(seconds(block.cost) for block in blocks)


words = st.builds(
    lambda n, kind: make_tag(f"D{n}", type=kind),
    st.integers(0, 120),
    st.sampled_from(["int16", "float32", "string[12]"]),
)
bits = st.builds(lambda n: make_tag(f"M{n}"), st.integers(0, 400))
rates = st.sampled_from([0.2, 1.0, 10.0])
mixed = st.builds(
    lambda text, every: make_tag(text, every=every),
    st.one_of(
        st.integers(0, 300).map("D{}".format),
        st.integers(0, 900).map("M{}".format),
        st.integers(200, 255).map("C{}".format),
        st.integers(0, 60).map("D{}.3".format),
    ),
    rates,
)
bauds = st.sampled_from([4800, 9600, 19200, 38400, 115200])


def partitions(count: int) -> Iterator[list[tuple[int, int]]]:
    """All ways to cut `count` things in a row into pieces."""
    for pattern in range(2 ** max(0, count - 1)):
        edges = [0, *(i + 1 for i in range(count - 1) if pattern >> i & 1), count]
        yield list(itertools.pairwise(edges))


def merged(tags: Sequence[Tag]) -> list[tuple[int, int]]:
    """Spans that overlap as one: written again here, on purpose."""
    found: list[tuple[int, int]] = []
    for start, end in sorted((t.span.start, t.span.start + t.span.size) for t in tags):
        if found and start < found[-1][1]:
            found[-1] = (found[-1][0], max(end, found[-1][1]))
        else:
            found.append((start, end))
    return found


def brute_force(area: str, tags: Sequence[Tag], seconds: partial[float], cuts: Cuts) -> float:
    items, best = merged(tags), float("inf")
    fences = [n for name, n in cuts if name == area]
    for pieces in partitions(len(items)):
        costs: list[Cost | None] = []
        for i, j in pieces:
            start, end = items[i][0], items[j - 1][1]
            fenced = j - i > 1 and any(
                a[1] <= n <= b[0]
                for a, b in zip(items[i:j], items[i + 1 : j], strict=False)
                for n in fences
            )
            costs.append(None if fenced else DRIVER.cost(Span(area, start, end - start)))
        if None not in costs:
            best = min(best, sum(seconds(cost) for cost in costs if cost))
    return best


@settings(max_examples=150)
@given(
    st.one_of(st.lists(words, min_size=1, max_size=9), st.lists(bits, min_size=1, max_size=9)),
    bauds,
    st.sampled_from([0.0, 0.005, 0.05]),
    st.sets(st.integers(0, 130), max_size=3),
)
def test_no_plan_of_one_interval_costs_less(
    tags: list[Tag], baud: int, turnaround: float, fences: set[int]
) -> None:
    seconds, area = at(baud, turnaround), tags[0].span.area
    cuts = frozenset((area, n) for n in fences)
    blocks = plan(tags, DRIVER, seconds, cuts)
    assert total(blocks, seconds) == pytest.approx(brute_force(area, tags, seconds, cuts))


@settings(max_examples=100)
@given(st.lists(mixed, max_size=40), bauds, st.sets(st.integers(0, 300), max_size=4))
def test_every_tag_is_read_once_within_the_limits_and_often_enough(
    tags: list[Tag], baud: int, fences: set[int]
) -> None:
    cuts = frozenset(("D", n) for n in fences)
    blocks = plan(tags, DRIVER, at(baud), cuts)
    asked = [tag for block in blocks for tag in block.tags]
    assert sorted(map(id, asked)) == sorted(map(id, tags))
    for block in blocks:
        assert block.cost == DRIVER.cost(block.span)
        assert block.every <= min(tag.every for tag in block.tags)
        for tag in block.tags:
            assert tag.span.area == block.span.area
            assert block.span.start <= tag.span.start
            assert tag.span.start + tag.span.size <= block.span.start + block.span.size


@settings(max_examples=50)
@given(st.lists(mixed, max_size=25), st.randoms(use_true_random=False))
def test_the_plan_does_not_depend_on_the_order_of_the_tags(tags: list[Tag], chance: object) -> None:
    tags = list({(tag.text, tag.every): tag for tag in tags}.values())
    shuffled = list(tags)
    chance.shuffle(shuffled)  # type: ignore[attr-defined]
    first, second = plan(tags, DRIVER, at(9600)), plan(shuffled, DRIVER, at(9600))
    assert [(b.span, b.every, b.cost) for b in first] == [(b.span, b.every, b.cost) for b in second]


@settings(max_examples=100)
@given(
    st.sets(st.integers(0, 60), min_size=1, max_size=20), st.sets(st.integers(0, 61), max_size=5)
)
def test_no_block_of_words_holds_both_sides_of_a_cut(numbers: set[int], fences: set[int]) -> None:
    tags = [make_tag(f"D{n}") for n in sorted(numbers)]
    for start, size in spans(plan(tags, DRIVER, at(9600), frozenset(("D", n) for n in fences))):
        assert not any(start < n < start + size for n in fences)


def test_a_cut_in_a_gap_is_kept() -> None:
    tags = [make_tag("D0"), make_tag("D6")]
    assert spans(plan(tags, DRIVER, at(9600))) == [(0, 7)]
    for n in range(1, 7):
        assert spans(plan(tags, DRIVER, at(9600), frozenset({("D", n)}))) == [(0, 1), (6, 1)]
    assert spans(plan(tags, DRIVER, at(9600), frozenset({("D", 0), ("D", 7), ("M", 3)}))) == [
        (0, 7)
    ]


def test_the_baud_rate_decides_which_gaps_a_block_spans() -> None:
    tags = [make_tag("D0"), make_tag("D14")]
    assert len(plan(tags, DRIVER, at(4800))) == 2
    assert len(plan(tags, DRIVER, at(115200))) == 1


def test_a_slower_tag_joins_a_faster_block() -> None:
    fast = [make_tag("D0", every=0.5), make_tag("D9", every=0.5)]
    slow = make_tag("D5", every=10.0)
    (block,) = plan([slow, *fast], DRIVER, at(19200))
    assert block.every == 0.5
    assert set(block.tags) == {slow, *fast}


def test_bits_and_words_of_one_address_share_a_block() -> None:
    tags = [
        make_tag("D7"),
        make_tag("D7.3"),
        make_tag("D7.4"),
        make_tag("D7", type="float32", name="f"),
    ]
    (block,) = plan(tags, DRIVER, at(9600))
    assert block.span == Span("D", 7, 2)
    samples = block.decoder.first([0b1000, 0], 5)
    assert [s.value for s in samples if s.tag.address.bit is not None] == [True, False]
    assert all(s.time == 5 for s in samples)


def test_words_without_a_value_give_a_bad_sample() -> None:
    (block,) = plan(
        [make_tag("D0", type="float32"), make_tag("D2", type="bcd16")], DRIVER, at(9600)
    )
    samples = block.decoder.first([0xFFFF, 0xFFFF, 0x00AB], 1)
    assert [(s.value, s.quality, s.reason) for s in samples] == [
        (None, Quality.BAD, Reason.NOT_A_NUMBER)
    ] * 2


def test_no_tags_give_no_blocks() -> None:
    assert plan([], DRIVER, at(9600)) == ()


def test_a_tag_too_long_for_a_request_is_an_error() -> None:
    with pytest.raises(ConfigError, match="D0 cannot be read in one request"):
        plan([make_tag("D0", type="string[200]")], DRIVER, at(9600))


def test_ten_times_the_tags_take_about_ten_times_as_long() -> None:
    """By the processor's clock; the least of some, for the machine may have other work."""
    modbus, wire = ModbusRtu(station=1), WireTiming(19200, 10)

    def took(count: int) -> float:
        tags = [make_tag(f"holding:{3 * n}", modbus, name=str(n)) for n in range(count)]
        best = float("inf")
        for _ in range(2):
            # Another function each time: the plans of equal rows are remembered by it.
            seconds = partial(wire.transaction, timing=modbus.timing, turnaround=0.01)
            start = time.process_time()
            plan(tags, modbus, seconds)
            best = min(best, time.process_time() - start)
        return best

    took(100)
    assert took(10_000) <= 15 * took(1_000)


@pytest.mark.parametrize("baud", [9600, 19200, 38400, 115200])
def test_the_two_hundred_register_set_is_planned_at_the_optimum(baud: int) -> None:
    wire = WireTiming(baud, 11)
    found = peers_requests.ours(wire)
    spent = sum(peers_requests.seconds(wire, size) for size in found)
    assert spent == pytest.approx(peers_requests.optimum(wire), rel=1e-9)
