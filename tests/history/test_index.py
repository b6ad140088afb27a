"""The index of a run: only samples that may be asked for are read, and none is left out."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange
from gateway.parts.history.store.index import GROUP, Index, pack

FEW = 100


def numbers(index: Index, tags: list[int], period: TimeRange) -> list[int]:
    return [n for places in index.places(tags, period, FEW) for n in places.numbers]


def test_a_tag_among_many_is_found_by_its_numbers() -> None:
    index = Index(pack([n % 100 for n in range(32_768)], range(32_768)))
    always = TimeRange(EARLIEST, LATEST)
    assert numbers(index, [5], always) == list(range(5, 32_768, 100))
    assert numbers(index, [5, 7], always) == sorted(
        [*range(5, 32_768, 100), *range(7, 32_768, 100)]
    )
    assert numbers(index, [100], always) == []
    assert numbers(index, [*range(101)], always) == list(range(32_768))
    few = index.places([5], TimeRange(10_000, 10_100), FEW)
    assert [places.first // GROUP for places in few] == [9]
    assert sum(len(places.numbers) for places in few) <= GROUP // 100 + 1


@given(
    st.lists(st.tuples(st.integers(1, 9), st.integers(0, 5000)), min_size=1, max_size=3000),
    st.lists(st.integers(1, 12), max_size=4),
    st.tuples(st.integers(0, 5000), st.integers(0, 5000)),
)
def test_no_sample_is_left_out(
    samples: list[tuple[int, int]], tags: list[int], ends: tuple[int, int]
) -> None:
    period = TimeRange(min(ends), max(ends))
    index = Index(pack([tag for tag, _ in samples], [time for _, time in samples]))
    wanted = {
        n for n, (tag, time) in enumerate(samples) if tag in tags and ends[0] <= time <= ends[1]
    }
    groups = index.places(tags, period, FEW)
    found = [n for places in groups for n in places.numbers]
    assert found == sorted(found)
    assert wanted <= set(found)
    for places in groups:
        assert all(samples[n][1] >= places.first for n in places.numbers)
