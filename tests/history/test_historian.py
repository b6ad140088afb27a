"""Recording and querying: every sample once, in order, at once."""

import json
import math
import random
import threading
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gateway.errors import BadValue, Busy
from gateway.parts.history.answers.recent import Recent
from gateway.parts.history.historian import Historian
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.rows import StoredRow
from gateway.protocols.driver import Span
from gateway.tags import Reason, bad, good
from gateway.values import Layout, Value, parse_type
from tests.history.recorded import (
    DOOR,
    EVERYTHING,
    NOON,
    SECOND,
    SMALL,
    SPEED,
    closed_runs,
    history,
    numbered,
    oldest_in_file,
    record_outcome,
    values,
    write,
)
from tests.history_writer import tag, until


def test_samples_of_all_types_survive_a_restart(tmp_path: Path) -> None:
    recorded: list[Value] = [True, False, 1, -5, 2**64 - 1, 0.1, math.inf, "", "Füllstand", "A\0B"]
    recorded += [(1, -2), (0.1, 2.0), (True, False)]
    samples = [good(SPEED, value, NOON + n) for n, value in enumerate(recorded)]
    samples.append(bad(SPEED, Reason.NO_REPLY, NOON + 100))
    with history(tmp_path / "h.db") as historian:
        historian.record(samples)
        assert list(historian.samples(SPEED, EVERYTHING, None)) == samples
    with history(tmp_path / "h.db") as historian:
        again = list(historian.samples(SPEED, EVERYTHING, None))
    assert again == samples
    assert [type(sample.value) for sample in again] == [type(sample.value) for sample in samples]


def test_arrays_make_a_run_shorter() -> None:
    """A run has to fit memory and `max_size`, however long its values are."""
    steps = replace(tag("steps"), layout=Layout(parse_type("int16[8]")), span=Span("D", 100, 8))
    recent = Recent(longest=10, oldest=60.0)
    recent.add(good(steps, (n,) * 8, NOON + n) for n in range(5))
    assert [len(run.samples) for run in recent.runs()] == [2, 2, 1]
    recent.add(good(SPEED, n, NOON + 10 + n) for n in range(12))
    assert [len(run.samples) for run in recent.runs()] == [2, 2, 6, 7]


def test_a_recorded_sample_is_found_before_it_is_stored(tmp_path: Path) -> None:
    with history(tmp_path / "h.db") as historian:
        for n in range(100):
            historian.record(numbered(1, n))
            assert values(historian)[-1] == n


def test_only_tags_with_history_are_recorded(tmp_path: Path) -> None:
    plain = tag("plain", history=False)
    with history(tmp_path / "h.db") as historian:
        historian.record([good(plain, 1, NOON), good(SPEED, 2, NOON)])
        assert values(historian) == [2]
        assert values(historian, plain) == []
        assert historian.document()["recorded"] == 1


def test_ranges_limits_and_unknown_tags(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", wall=lambda: NOON + 5 * SECOND, max_size=SMALL) as historian:
        historian.record(numbered(7000))  # in several runs
        until(historian, waiting=0)
        assert values(historian, time_range="[now(-2s)..now()]") == [3, 4, 5]
        assert values(historian, time_range="]now(-2s)..now()[") == [4]
        assert values(historian, time_range="[2026-11-21T13:56:38Z..]") == [6998, 6999]
        assert values(historian, time_range="[now()..now(-2s)]") == []
        first = [sample.value for sample in historian.samples(SPEED, "[now()..]", 3)]
        assert first == [5, 6, 7]
        assert values(historian, DOOR) == []
        for limit in (0, -1, 2**70):
            with pytest.raises(BadValue, match="limit"):
                historian.samples(SPEED, EVERYTHING, limit)
        with pytest.raises(BadValue, match="range"):
            historian.samples(SPEED, "yesterday", None)


def test_now_is_the_time_of_the_query_not_of_the_answer(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", wall=lambda: NOON + 50 * SECOND) as historian:
        historian.record(numbered(100))
        for number in range(10):
            record_outcome(historian, write(number))
        queried = NOON + 5 * SECOND
        found = historian.samples(SPEED, "[now(-2s)..now()]", None, queried)
        assert [sample.value for sample in found] == [3, 4, 5]
        outcomes = historian.writes("[now(-2s)..now()]", None, queried)
        assert [json.loads(line)["value"] for line in outcomes] == [3, 4, 5]


def test_two_samples_of_one_moment_are_both_kept_in_their_order(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        historian.record(good(SPEED, n, NOON) for n in range(5000))
        until(historian, waiting=0)
        assert values(historian) == list(range(5000))
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        assert values(historian) == list(range(5000))


def test_a_clock_set_back_loses_nothing_and_the_answer_is_in_order(tmp_path: Path) -> None:
    chance = random.Random(1)
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        times = [NOON + n * SECOND for n in range(6000)]
        times += [NOON - 500 * SECOND + n * SECOND for n in range(5000)]
        times += [chance.randrange(NOON, NOON + 3000 * SECOND) for _ in range(500)]
        for at in range(0, len(times), 100):
            historian.record(good(SPEED, at, time) for time in times[at : at + 100])
        until(historian, waiting=0)
        found = [sample.time for sample in historian.samples(SPEED, EVERYTHING, None)]
    assert found == sorted(times)
    assert len(closed_runs(tmp_path / "h.db")) == 5


def test_queries_see_each_sample_once_while_runs_move_to_disk(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=3_000_000) as historian:
        ended = threading.Event()

        def record() -> None:
            for n in range(0, 30_000, 50):
                historian.record(numbered(50, n))
                if n % 5000 == 0:
                    until(historian, waiting=0)  # the disk keeps up
            ended.set()

        thread = threading.Thread(target=record)
        thread.start()
        queries = 0
        while not ended.is_set():
            found = values(historian)
            assert found == list(range(len(found)))
            queries += 1
        thread.join()
        assert queries > 5
        assert values(historian) == list(range(30_000))
        assert historian.document()["lost"] == 0


def test_an_answer_of_very_many_samples_takes_little_memory(tmp_path: Path) -> None:
    count = 200_000  # 50 MB; an answer holds one run of 32,768 at a time
    with history(tmp_path / "h.db") as historian:
        for first in range(0, count, 1000):
            historian.record(good(SPEED, n, NOON + n) for n in range(first, first + 1000))
    with history(tmp_path / "h.db") as historian:
        found = historian.samples(SPEED, EVERYTHING, None)
        tracemalloc.start()
        try:
            assert sum(1 for _ in found) == count
            _, most = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert most < 15_000_000


def test_a_slow_reader_gets_all_and_delays_neither_log_nor_writer(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=20_000_000) as historian:
        historian.record(numbered(60_000))
        until(historian, waiting=0)
        slow = historian.samples(SPEED, EVERYTHING, None)
        found = [next(slow).value for _ in range(10)]
        for n in range(100_000, 160_000, 5000):
            historian.record(numbered(5000, n))
            until(historian, waiting=0)
            assert Path(f"{path}-wal").stat().st_size < 2_500_000
        found.extend(sample.value for sample in slow)
    assert found == list(range(60_000))


def flooded(historian: Historian, first: int, last: int) -> None:
    for start in range(first, last, 1000):
        historian.record(numbered(1000, start))
        until(historian, waiting=0)


def test_an_answer_whose_next_samples_are_dropped_ends_with_an_error(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        flooded(historian, 0, 20_000)
        answer = historian.samples(SPEED, EVERYTHING, None)
        found = [next(answer).value for _ in range(10)]
        flooded(historian, 20_000, 45_000)
        with pytest.raises(Busy, match="dropped meanwhile"):
            found.extend(sample.value for sample in answer)
        assert found == list(range(len(found)))


def test_an_answer_begins_with_the_oldest_sample_that_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = Reader.rows

    def late(reader: Reader, *arguments: Any) -> tuple[list[StoredRow], bool] | None:
        monkeypatch.undo()
        first = oldest_in_file(path)
        for start in range(20_000, 60_000, 1000):
            if oldest_in_file(path) == first:
                flooded(historian, start, start + 1000)
        rows: tuple[list[StoredRow], bool] | None = at_once(reader, *arguments)
        return rows

    path = tmp_path / "h.db"
    with history(path, max_size=SMALL) as historian:
        flooded(historian, 0, 20_000)
        monkeypatch.setattr(Reader, "rows", late)
        found = values(historian)
        assert isinstance(found[0], int)
        assert found[0] > 0
        assert found == list(range(found[0], 20_000))
