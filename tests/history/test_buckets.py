"""Buckets against a plain aggregation over the same samples, exactly, with fractions."""

import random
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.past.buckets import MOST_BUCKETS, NOT_RECORDED, Bucket, Now, Step, buckets
from gateway.contract.past.history_query import HistoryQuery, question
from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange
from gateway.errors import BadValue, Damaged
from gateway.parts.history.answers.bucket_search import DAMAGED, BucketSearch
from gateway.parts.history.answers.recent import Recent
from gateway.parts.history.answers.search import Search
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.file import HistoryFile
from gateway.parts.history.store.reader import Reader
from gateway.tags import Reason, Sample, bad, good
from tests.history.recorded import DOOR, NOON, SECOND, SPEED, all_runs, store_run

MINUTE = 60 * SECOND
ALWAYS = TimeRange(EARLIEST, LATEST)


def plain(
    steps: Sequence[Step], width: int, period: TimeRange, now: int, from_start: bool = False
) -> list[dict[str, Any]]:
    """The same buckets, each by looking at all samples."""
    if not steps:
        return []
    first = steps[0][0] if period.first == EARLIEST else period.first
    inside = [step for step in steps if first <= step[0] <= period.last]
    stop = min(period.last + 1, max([now, *(time + 1 for time, _, _ in inside)]))
    found = []
    origin = first if from_start else first // width * width
    for begin in range(origin, stop, width) if stop > first else ():
        start, end = max(begin, first), min(begin + width, stop)
        here = [s for s in inside if start <= s[0] < end and s[2] != NOT_RECORDED]
        valid: list[tuple[Any, int]] = [(value, 0) for _, value, _ in here if value is not None]
        for number, (time, value, _) in enumerate(steps):
            until = steps[number + 1][0] if number + 1 < len(steps) else stop
            overlap = min(until, end) - max(time, start)
            if value is not None and overlap > 0:
                valid.append((value, overlap))
        numbers = [(value, weight) for value, weight in valid if not isinstance(value, str)]
        weight = sum(weight for _, weight in numbers)
        total = sum(Fraction(value) * weight for value, weight in numbers)
        mean = total / weight if weight else Fraction(numbers[-1][0]) if numbers else None
        found.append(
            {
                "time": begin,
                "start": start,
                "end": end,
                "known": sum(weight for _, weight in valid),
                "good": sum(value is not None for _, value, _ in here),
                "bad": sum(value is None for _, value, _ in here),
                "min": min((value for value, _ in numbers), default=None),
                "max": max((value for value, _ in numbers), default=None),
                "mean": None if len(numbers) < len(valid) else mean,
                "last": last_valid(steps, start, end),
            }
        )
    return found


def last_valid(steps: Sequence[Step], start: int, end: int) -> Any:
    value_at_start = None
    last = None
    for time, value, _ in steps:
        if time <= start:
            value_at_start = value
        if start <= time < end and value is not None:
            last = value
    return value_at_start if last is None else last


def compare(found: Sequence[Bucket], expected: Sequence[dict[str, Any]]) -> None:
    assert len(found) == len(expected)
    for bucket, wanted in zip(found, expected, strict=True):
        fields = bucket._asdict()
        mean, exact = fields.pop("mean"), wanted.pop("mean")
        assert {name: fields[name] for name in wanted} == wanted
        if exact is None:
            assert mean is None
        else:
            assert mean == pytest.approx(float(exact), rel=1e-9, abs=1e-6)
            assert float(wanted["min"]) <= mean <= float(wanted["max"])
        covered = wanted["end"] - wanted["start"]
        is_whole = wanted["known"] == covered and not wanted["bad"]
        assert (bucket.quality == "good") is is_whole
        has_none = wanted["min"] is None and wanted["last"] is None
        assert (bucket.quality == "bad") is has_none
        assert is_whole or bucket.reason is not None


VALUES = st.one_of(
    st.none(),
    st.integers(-(2**63), 2**64),
    st.floats(-1e6, 1e6),
    st.booleans(),
)
STEPS = st.lists(st.tuples(st.integers(0, 400), VALUES), max_size=25)


@given(
    STEPS,
    st.integers(1, 150),
    st.one_of(st.none(), st.integers(-50, 450)),
    st.one_of(st.none(), st.integers(-50, 450)),
    st.integers(-100, 500),
    st.booleans(),
)
def test_buckets_are_those_of_a_plain_aggregation(
    found: list[tuple[int, Any]],
    width: int,
    first: int | None,
    last: int | None,
    now: int,
    from_start: bool,
) -> None:
    found.sort(key=lambda step: step[0])
    steps: list[Step] = [(t, v, "no-reply" if v is None else None) for t, v in found]
    period = TimeRange(EARLIEST if first is None else first, LATEST if last is None else last)
    compare(
        [*buckets(steps, width, period, now, from_start=from_start)],
        plain(steps, width, period, now, from_start),
    )


def test_an_hour_of_two_values_and_a_gap() -> None:
    steps: list[Step] = [
        (0, 10, None),
        (90, 20, None),
        (150, None, "no-reply"),
        (400, 30, None),
    ]
    found = [*buckets(steps, 60, TimeRange(30, 419), 10**6)]
    assert [(b.time, b.quality, b.min, b.max, b.mean, b.last, b.known) for b in found] == [
        (0, "good", 10, 10, 10.0, 10, 30),
        (60, "good", 10, 20, 15.0, 20, 60),
        (120, "partial", 20, 20, 20.0, 20, 30),
        (180, "bad", None, None, None, None, 0),
        (240, "bad", None, None, None, None, 0),
        (300, "bad", None, None, None, None, 0),
        (360, "partial", 30, 30, 30.0, 30, 20),
    ]
    assert [b.reason for b in found] == [None, None, *["no-reply"] * 5]
    assert [(b.good, b.bad) for b in found] == [(0, 0), (1, 0), (0, 1), *[(0, 0)] * 3, (1, 0)]


def test_texts_have_a_last_value_only_and_booleans_a_share_of_time() -> None:
    [text] = buckets([(0, "A", None), (5, "B", None)], 10, TimeRange(0, 9), 10)
    assert (text.min, text.max, text.mean, text.last, text.quality) == (
        None,
        None,
        None,
        "B",
        "good",
    )
    [array] = buckets([(0, (1, 2), None), (5, (3, 4), None)], 10, TimeRange(0, 9), 10)
    assert (array.min, array.max, array.mean, array.last, array.good) == (
        None,
        None,
        None,
        (3, 4),
        2,
    )
    [other] = buckets([(0, 5, None), (5, (3, 4), None)], 10, TimeRange(0, 9), 10)  # another type
    assert (other.mean, other.last, other.known) == (None, (3, 4), 10)
    [bit] = buckets([(0, True, None), (4, False, None)], 10, TimeRange(0, 9), 10)
    assert (bit.min, bit.max, bit.mean, bit.last) == (False, True, 0.4, False)
    huge = [(0, 1.7e308, None), (5, -1.7e308, None)]
    [wide] = buckets(huge, 10, TimeRange(0, 9), 10)
    assert wide.mean is None or wide.min <= wide.mean <= wide.max  # type: ignore[operator]


def test_a_range_with_too_many_buckets_is_refused() -> None:
    last = MOST_BUCKETS * SECOND
    with pytest.raises(BadValue, match=r"10001 buckets, more than 10000: .* at least 1 s"):
        next(buckets([(0, 1, None)], SECOND, TimeRange(0, last), 2 * last))
    assert len([*buckets([(0, 1, None)], SECOND, TimeRange(0, last - 1), 2 * last)]) == MOST_BUCKETS
    wrong_clock: list[Step] = [(0, 1, None), (2**62, 2, None)]
    with pytest.raises(BadValue, match="buckets, more than"):
        [*buckets(wrong_clock, SECOND, ALWAYS, 10 * SECOND)]


# -- with a file ---------------------------------------------------------------------------------


def samples(count: int, seed: int) -> list[Sample]:
    """Samples of two tags with gaps; the clock is set back a few times."""
    chance, time, found = random.Random(seed), NOON, list[Sample]()
    for _ in range(count):
        time += chance.choice([0, 1, SECOND, 7 * SECOND, 20 * SECOND])
        if chance.random() < 0.002:
            time -= 300 * SECOND
        tag = chance.choice([SPEED, SPEED, DOOR])
        if chance.random() < 0.1:
            found.append(bad(tag, Reason.NO_REPLY, time))
        else:
            found.append(good(tag, chance.choice([chance.randint(-9, 9), chance.random()]), time))
    return found


@contextmanager
def filed(path: Path, runs: Sequence[Sequence[Sample]]) -> Iterator[tuple[BucketSearch, Search]]:
    """A file with all runs but the last, which is in memory."""
    with closing(HistoryFile(path, 10**8)) as file:
        for run in runs[:-1]:
            store_run(file, run)
        recent = Recent(10**6, 600)
        recent.opened(file.identity, (), file.extent, file.next_number())
        recent.set_sorted(all_runs(file))
        recent.add(runs[-1])
        reader = Reader(path)
        try:
            yield BucketSearch(recent, reader, Damage()), Search(recent, reader, Damage())
        finally:
            reader.renew()


def nothing() -> None:
    """Pauses nobody."""


def steps_of(found: Sequence[Sample]) -> list[Step]:
    of_tag = [sample for sample in found if sample.tag is SPEED]
    of_tag.sort(key=lambda sample: sample.time)
    return [(s.time, s.value, None if s.reason is None else str(s.reason)) for s in of_tag]


def test_buckets_of_a_file_and_of_memory_are_those_of_a_plain_aggregation(tmp_path: Path) -> None:
    chance, recorded = random.Random(5), samples(1500, 5)
    steps = steps_of(recorded)
    begin, end = steps[0][0], steps[-1][0]
    runs = [recorded[n : n + 150] for n in range(0, 1500, 150)]
    with filed(tmp_path / "h.db", runs) as (course, search):
        for number in range(25):
            first = chance.randint(begin - MINUTE, end)
            last = chance.randint(first, end + MINUTE)
            period = ALWAYS if number == 0 else TimeRange(first, last)
            now = chance.randint(first, end + 10 * MINUTE) if number else end
            width = chance.choice([MINUTE, 7 * MINUTE, (last - first) // 3 + 1])
            answer = [*course.buckets(SPEED, period, width, Now(now, is_valid=True), nothing)]
            compare(answer, plain([s for s in steps if s[0] <= period.last], width, period, now))
            for count in (1, 100, 2000):
                last_ones = search.newest(SPEED, period, count, nothing, only_good=False)
                inside = [s for s in steps if period.first <= s[0] <= period.last]
                shown = [(sample.time, sample.value) for sample in last_ones]
                assert shown == [(time, value) for time, value, _ in inside[-count:]]


def at(seconds: float) -> int:
    return NOON + int(seconds * SECOND)


def drawn(course: BucketSearch, first: float, last: float, now: Now) -> list[tuple[str, float]]:
    """Returns quality and known seconds of buckets of ten seconds."""
    period = TimeRange(at(first), at(last) - 1)
    found = course.buckets(SPEED, period, 10 * SECOND, now, nothing)
    return [(bucket.quality, bucket.known / SECOND) for bucket in found]


def test_a_value_is_not_valid_while_no_gateway_ran(tmp_path: Path) -> None:
    before = [good(SPEED, 5, at(0)), good(DOOR, 1, at(12))]  # the last one of any tag
    after = [bad(SPEED, Reason.STARTING, at(40)), good(SPEED, 5, at(50))]
    with filed(tmp_path / "h.db", [before, after, []]) as (course, _):
        assert drawn(course, 0, 70, Now(at(65), is_valid=True)) == [
            ("good", 10),
            ("partial", 2),
            ("bad", 0),
            ("bad", 0),
            ("bad", 0),
            ("good", 10),
            ("good", 5),
        ]
        # Its device is not served now: it is valid until the last sample that was recorded.
        assert drawn(course, 50, 70, Now(at(65), is_valid=False)) == [("partial", 0), ("bad", 0)]
        # The value at the beginning was recorded long before.
        assert drawn(course, 10, 30, Now(at(65), is_valid=True)) == [("partial", 2), ("bad", 0)]


def test_a_start_of_one_tag_ends_its_value_at_the_last_sample_of_another(tmp_path: Path) -> None:
    """A changed file is loaded while the gateway runs."""
    samples = [good(SPEED, 5, at(0)), good(DOOR, 1, at(12)), bad(SPEED, Reason.STARTING, at(15))]
    for runs in ([samples], [samples[:1], samples[1:]], [samples, [good(DOOR, 2, at(30))]]):
        with filed(tmp_path / f"{len(runs[-1])}.db", runs) as (course, _):
            assert drawn(course, 0, 20, Now(at(40), is_valid=True)) == [
                ("good", 10),
                ("partial", 2),
            ]


def test_a_value_is_not_valid_over_samples_that_are_lost(tmp_path: Path) -> None:
    runs = [[good(SPEED, n, at(n)) for n in range(begin, begin + 10)] for begin in (0, 10, 20, 30)]
    with filed(tmp_path / "h.db", [*runs, []]) as (course, _):
        with closing(sqlite3.connect(tmp_path / "h.db")) as file:
            file.execute("UPDATE sample SET value = 7 WHERE value = 15")
            file.commit()
        answer = course.buckets(SPEED, ALWAYS, 10 * SECOND, Now(at(40), is_valid=True), nothing)
        found = [(b.quality, b.min, b.max, b.reason) for b in islice(answer, 4)]
        with pytest.raises(Damaged, match="are lost"):
            next(answer)
        assert found == [
            ("good", 0, 9, None),
            ("bad", None, None, DAMAGED),
            ("good", 20, 29, None),
            ("good", 30, 39, None),
        ]
        period = TimeRange(at(19.5), at(21) - 1)
        [begin] = course.buckets(SPEED, period, 10**12, Now(at(40), is_valid=True), nothing)
        assert (begin.quality, begin.known) == ("partial", SECOND)  # the value before is lost


def test_only_good_newest_samples(tmp_path: Path) -> None:
    runs = [[good(SPEED, n, at(n)), bad(SPEED, Reason.NO_REPLY, at(n + 0.5))] for n in range(4)]
    with filed(tmp_path / "h.db", runs) as (_, search):
        found = search.newest(SPEED, ALWAYS, 3, nothing, only_good=True)
        assert [sample.value for sample in found] == [1, 2, 3]
        both = [*search.newest(SPEED, ALWAYS, 3, nothing, only_good=False)]
        assert [sample.value for sample in both] == [None, 3, None]


# -- parameters ----------------------------------------------------------------------------------


def asked(text: str) -> HistoryQuery:
    return question(dict(part.split("=", 1) for part in text.split(";")))


def test_parameters() -> None:
    assert asked("_time=[..];bucket=1min;agg=last,min") == HistoryQuery(
        "[..]", MINUTE, ("min", "last"), None
    )
    assert [
        asked(f"_time=[..];bucket={text}").bucket for text in ("90", "500ms", "1.5h", "2d")
    ] == [
        90 * SECOND,
        SECOND // 2,
        5400 * SECOND,
        2 * 86400 * SECOND,
    ]
    assert asked("last=100;quality=good") == HistoryQuery("[..]", last=100, only_good=True)
    assert asked("_time=[..];limit=5;x=1;_y=2") == HistoryQuery("[..]")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("bucket=1min", "bucket=1min needs a range of time, such as _time=[now(-1h)..]"),
        ("_time=[..];bucket=soon", "bucket=soon is no duration such as 10s, 1min or 1h"),
        ("_time=[..];bucket=0s", "bucket=0s must be longer than 0, and at most 100 years"),
        ("_time=[..];bucket=-1m", "bucket=-1m is no duration such as 10s, 1min or 1h"),
        ("_time=[..];agg=min", "agg=min needs a bucket, such as bucket=1min"),
        (
            "_time=[..];bucket=1m;agg=min,avg",
            "agg=min,avg: 'avg' is none of min, max, mean, last",
        ),
        ("_time=[..];align=start", "align=start needs a bucket, such as bucket=1min"),
        ("_time=[..];bucket=1m;align=end", "align=end is neither start nor utc"),
        ("last=0", "last=0 is no count from 1 to 100000"),
        ("last=many", "last=many is no count from 1 to 100000"),
        ("last=5;limit=5", "last and limit exclude each other: send one of them"),
        (
            "_time=[..];bucket=1m;last=5",
            "bucket and last exclude each other: send one of them",
        ),
        (
            "_time=[..];bucket=1m;page=5",
            "bucket and page exclude each other: send one of them",
        ),
        ("last=5;quality=bad", "quality=bad is neither good nor any"),
        ("_time=[..];buckets=1m", "buckets is no parameter: did you mean bucket?"),
    ],
)
def test_mistakes_in_parameters_are_told(text: str, sentence: str) -> None:
    with pytest.raises(BadValue) as error:
        asked(text)
    assert str(error.value) == sentence
