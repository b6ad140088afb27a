"""History: nothing recorded is lost but what the rules say, whatever the disk does."""

import errno
import fcntl
import json
import math
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.engine.requests import CommandResult
from gateway.errors import BadValue, Busy
from gateway.history import Historian, TimeRange, lock, time_range
from gateway.history.file import HistoryFile
from gateway.history.outcomes import MOST_WAITING, Outcome
from gateway.history.reader import Part, Reader, in_order
from gateway.history.recent import MOST_RUNS, Identity
from gateway.history.rows import from_row, to_row
from gateway.history.timerange import EARLIEST, LATEST
from gateway.northbound.payload import Failure, Problem, WriteOutcome
from gateway.tags import Quality, Reason, Sample, Tag, WriteResult, bad, good
from gateway.values import Value
from tests.history_writer import NOBODY, TAGS, WEEK, tag, until

SPEED, DOOR = tag("speed"), tag("door")
SECOND = 10**9
NOON = 1_795_262_400 * SECOND  # 2026-11-21T12:00:00Z
EVERYTHING = "[..]"
SMALL = 2_000_000  # bytes: makes runs of 1953 samples


@contextmanager
def history(
    path: Path, keep: float = WEEK, max_size: int = 10**8, **how: Any
) -> Iterator[Historian]:
    historian = Historian(path, keep, max_size, **how)
    historian.start()
    try:
        until(historian, state="ok")
        yield historian
    finally:
        assert historian.close(10)


def values(historian: Historian, tag: Tag = SPEED, asked: str = EVERYTHING) -> list[Value | None]:
    return [sample.value for sample in historian.samples(tag, asked, None)]


def numbered(count: int, start: int = 0, tag: Tag = SPEED) -> Iterable[Sample]:
    return [good(tag, n, NOON + n * SECOND) for n in range(start, start + count)]


def sorted_runs(path: Path) -> list[tuple[int, int]]:
    with closing(sqlite3.connect(path)) as database:
        return list(database.execute("SELECT run, samples FROM run ORDER BY run"))


# -- ranges ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("[..]", EARLIEST, LATEST),
        ("]..[", EARLIEST, LATEST),
        ("[now(-1h)..]", NOON - 3600 * SECOND, LATEST),
        ("[now(-1.5h)..now()]", NOON - 5400 * SECOND, NOON),
        ("[..now(-500ms)]", EARLIEST, NOON - SECOND // 2),
        ("[now(-2)..now(+7u)]", NOON - 2 * SECOND, NOON + 7000),
        ("[now(-1w)..now(1d)]", NOON - 7 * 86400 * SECOND, NOON + 86400 * SECOND),
        ("[2026-11-21T12:00:00Z..]", NOON, LATEST),
        ("]2026-11-21T12:00:00Z..", None, None),
        ("]2026-11-21T12:00:00Z..2026-11-21T12:00:01.5Z[", NOON + 1, NOON + 3 * SECOND // 2 - 1),
        ("[2026-11-21 12:00:00.000000001..2026-11-21T14:00:02+02:00]", NOON + 1, NOON + 2 * SECOND),
        ("[1969-12-31T23:59:59.25Z..1970-01-01T00:00:00Z]", -3 * SECOND // 4, 0),
        ("[0001-01-01T00:00:00Z..9999-12-31T23:59:59Z]", EARLIEST, LATEST),
        ("[now(-999999999999999999w)..]", EARLIEST, LATEST),
    ],
)
def test_a_range_is_read_as_zenoh_writes_it(text: str, first: int | None, last: int) -> None:
    if first is None:
        with pytest.raises(BadValue):
            time_range(text, NOON)
    else:
        assert time_range(text, NOON) == TimeRange(first, last)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "..",
        "[now(-1h)",  # what Zenoh leaves of `[now(-1h);30m]`
        "[now(-1h);30m]",
        "[now..]",
        "[now(-)..]",
        "[now(-1y)..]",
        "[now(--1h)..]",
        "[yesterday..]",
        "[2026-11-21..]",
        "[2026-02-30T12:00:00Z..]",
        "[2026-11-21T12:00:61Z..]",
        "[2026-11-21T12:00:00.1234567890Z..]",
        "[..now()..]",
        "(now()..)",
    ],
)
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(BadValue):
        time_range(text, NOON)


@given(st.text("[].now()-+0123456789smhdTZ: \x00é", max_size=40))
def test_any_text_is_a_range_or_refused(text: str) -> None:
    try:
        first, last = time_range(f"[{text}", NOON)
    except BadValue:
        return
    assert EARLIEST <= first <= LATEST
    assert EARLIEST <= last <= LATEST


# -- what comes back ---------------------------------------------------------------------------

any_value = st.one_of(
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.sampled_from([2**63 - 1, 2**63, 2**64 - 1, -(2**63)]),
    st.floats(),
    st.text(st.characters(exclude_categories=())),
)


@given(any_value, st.integers(EARLIEST, LATEST))
def test_a_value_comes_back_from_sqlite_as_exactly_what_it_was(value: Value, time: int) -> None:
    with closing(sqlite3.connect(":memory:")) as database:
        row = database.execute("SELECT ?, ?, ?, ?", to_row(good(SPEED, value, time))).fetchone()
    sample = from_row(SPEED, row)
    assert type(sample.value) is type(value)
    assert repr(sample.value) == repr(value)
    assert sample._replace(value=None) == Sample(SPEED, None, Quality.GOOD, time)


@pytest.mark.parametrize("reason", [*Reason, None])
def test_bad_samples_keep_their_reason(reason: Reason | None) -> None:
    sample = Sample(SPEED, None, Quality.BAD, NOON, reason)
    assert from_row(SPEED, to_row(sample)) == sample


def test_samples_of_all_types_outlive_a_restart(tmp_path: Path) -> None:
    told: list[Value] = [True, False, 1, -5, 2**64 - 1, 0.1, math.inf, "", "Füllstand", "A\0B"]
    samples = [good(SPEED, value, NOON + n) for n, value in enumerate(told)]
    samples.append(bad(SPEED, Reason.NO_REPLY, NOON + 100))
    with history(tmp_path / "h.db") as historian:
        historian.record(samples)
        assert list(historian.samples(SPEED, EVERYTHING, None)) == samples
    with history(tmp_path / "h.db") as historian:
        again = list(historian.samples(SPEED, EVERYTHING, None))
    assert again == samples
    assert [type(sample.value) for sample in again] == [type(sample.value) for sample in samples]


def test_what_was_recorded_is_found_at_once_not_only_after_it_was_stored(tmp_path: Path) -> None:
    with history(tmp_path / "h.db") as historian:
        for n in range(100):
            historian.record(numbered(1, n))
            assert values(historian)[-1] == n


def test_only_tags_with_history_are_kept(tmp_path: Path) -> None:
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
        assert values(historian, asked="[now(-2s)..now()]") == [3, 4, 5]
        assert values(historian, asked="]now(-2s)..now()[") == [4]
        assert values(historian, asked="[2026-11-21T13:56:38Z..]") == [6998, 6999]
        assert values(historian, asked="[now()..now(-2s)]") == []
        first = [sample.value for sample in historian.samples(SPEED, "[now()..]", 3)]
        assert first == [5, 6, 7]
        assert values(historian, DOOR) == []
        for limit in (0, -1, 2**70):
            with pytest.raises(BadValue, match="limit"):
                historian.samples(SPEED, EVERYTHING, limit)
        with pytest.raises(BadValue, match="range"):
            historian.samples(SPEED, "yesterday", None)


def test_now_is_when_it_was_asked_not_when_it_is_answered(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", wall=lambda: NOON + 50 * SECOND) as historian:
        historian.record(numbered(100))
        for number in range(10):
            historian.record_write(write(number))
        asked = NOON + 5 * SECOND
        found = historian.samples(SPEED, "[now(-2s)..now()]", None, asked)
        assert [sample.value for sample in found] == [3, 4, 5]
        told = historian.writes("[now(-2s)..now()]", None, asked)
        assert [json.loads(line)["value"] for line in told] == [3, 4, 5]


def test_two_samples_of_one_moment_are_both_kept_in_their_order(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        historian.record(good(SPEED, n, NOON) for n in range(5000))
        until(historian, waiting=0)
        assert values(historian) == list(range(5000))
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        assert values(historian) == list(range(5000))


def test_a_clock_set_back_loses_nothing_and_the_answer_is_in_order(tmp_path: Path) -> None:
    told = random.Random(1)
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        times = [NOON + n * SECOND for n in range(6000)]
        times += [NOON - 500 * SECOND + n * SECOND for n in range(5000)]
        times += [told.randrange(NOON, NOON + 3000 * SECOND) for _ in range(500)]
        for at in range(0, len(times), 100):
            historian.record(good(SPEED, at, time) for time in times[at : at + 100])
        until(historian, waiting=0)
        found = [sample.time for sample in historian.samples(SPEED, EVERYTHING, None)]
    assert found == sorted(times)
    assert len(sorted_runs(tmp_path / "h.db")) == 5


@given(st.lists(st.lists(st.integers(0, 50), max_size=8), max_size=8))
def test_overlapping_parts_are_merged_by_time(times: list[list[int]]) -> None:
    runs = [
        sorted((good(SPEED, n, t) for t in run), key=lambda s: s.time)
        for n, run in enumerate(times)
    ]
    parts = [Part(run[0].time if run else 0, lambda run=run: run) for run in runs]
    expected = sorted((sample for run in runs for sample in run), key=lambda s: (s.time, s.value))
    assert list(in_order(parts)) == expected


def test_a_part_is_not_read_before_its_time() -> None:
    read: list[int] = []

    def part(first: int) -> Part:
        return Part(first, lambda: read.append(first) or [good(SPEED, first, first)])

    answers = in_order([part(first) for first in range(100)])
    assert [next(answers).value for _ in range(3)] == [0, 1, 2]
    assert read == [0, 1, 2]


def test_questions_see_each_sample_once_while_runs_move_to_disk(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=3_000_000) as historian:
        ended = threading.Event()

        def tell() -> None:
            for n in range(0, 30_000, 50):
                historian.record(numbered(50, n))
                if n % 5000 == 0:
                    until(historian, waiting=0)  # the disk keeps up
            ended.set()

        thread = threading.Thread(target=tell)
        thread.start()
        asked = 0
        while not ended.is_set():
            found = values(historian)
            assert found == list(range(len(found)))
            asked += 1
        thread.join()
        assert asked > 5
        assert values(historian) == list(range(30_000))
        assert historian.document()["lost"] == 0


def test_an_answer_of_very_many_samples_does_not_sit_in_memory(tmp_path: Path) -> None:
    count = 200_000  # 50 MB of them; what is held is one run of 32,768 at a time
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


def test_a_slow_reader_gets_all_and_holds_up_neither_log_nor_writer(tmp_path: Path) -> None:
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


def test_an_answer_whose_rest_is_dropped_meanwhile_ends_with_an_error(tmp_path: Path) -> None:
    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        flooded(historian, 0, 20_000)
        answer = historian.samples(SPEED, EVERYTHING, None)
        found = [next(answer).value for _ in range(10)]
        flooded(historian, 20_000, 45_000)
        with pytest.raises(Busy, match="dropped meanwhile"):
            found.extend(sample.value for sample in answer)
        assert found == list(range(len(found)))


def test_an_answer_not_yet_begun_begins_with_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_once = Reader.samples

    def late(reader: Reader, *asked: Any) -> list[Sample] | None:
        monkeypatch.undo()
        first = historian.document()["oldest"]
        for start in range(20_000, 60_000, 1000):
            if historian.document()["oldest"] == first:
                flooded(historian, start, start + 1000)
        return at_once(reader, *asked)

    with history(tmp_path / "h.db", max_size=SMALL) as historian:
        flooded(historian, 0, 20_000)
        monkeypatch.setattr(Reader, "samples", late)
        found = values(historian)
        assert isinstance(found[0], int)
        assert found[0] > 0
        assert found == list(range(found[0], 20_000))


def test_a_run_that_has_the_number_of_one_that_is_gone_is_another(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with closing(HistoryFile(path, 10**8)) as file:
        file.store(1, 0, numbered(10))
        before = file.sort(1, NOON)
        file.drop(1)
        file.store(1, 0, numbered(10, 10))
        after = file.sort(1, NOON + SECOND)
        assert before is not None
        assert after is not None
        everything = TimeRange(EARLIEST, LATEST)
        reader = Reader(path)
        assert reader.samples(file.identity, SPEED, before, everything, None) is None
        assert reader.samples(file.identity, SPEED, after, everything, None)


def test_writes_that_are_dropped_while_they_are_told_end_the_answer(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    everything = TimeRange(EARLIEST, LATEST)
    with closing(HistoryFile(path, 10**8)) as file:
        outcomes = [Outcome(NOON + n, str(n)) for n in range(2500)]
        last = file.store_writes(outcomes, 2500)
        told = Reader(path).writes(file.identity, last, everything)
        found = [next(told).told for _ in range(10)]
        assert file.store_writes([Outcome(NOON + 2500, "2500")], 500) == 2501
        with pytest.raises(Busy, match="dropped meanwhile"):
            found.extend(outcome.told for outcome in told)
        assert found == [str(n) for n in range(len(found))]


# -- what is kept ------------------------------------------------------------------------------


def test_the_oldest_go_first_when_the_file_is_full(tmp_path: Path) -> None:
    path, most = tmp_path / "h.db", 2_000_000
    with history(path, max_size=most) as historian:
        largest = 0
        for n in range(0, 150_000, 5000):
            historian.record(numbered(5000, n))
            until(historian, waiting=0)
            files = (path, Path(f"{path}-wal"))
            largest = max(largest, sum(file.stat().st_size for file in files))
        found = values(historian)
        assert historian.document()["lost"] == 0
        oldest = str(historian.document()["oldest"])
    assert largest <= most
    assert isinstance(found[0], int)
    assert 0 < found[0] < 140_000
    assert found == list(range(found[0], 150_000))
    assert len(found) > 15_000  # of 2 MB some use is made
    assert time_range(f"[{oldest}..]", 0).first == NOON + found[0] * SECOND


def test_behind_a_link_the_log_counts_too(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    path, real = tmp_path / "h.db", tmp_path / "disk" / "h.db"
    path.symlink_to(real)
    with history(path) as historian:
        historian.record(numbered(1000))
        until(historian, waiting=0)
        assert Path(f"{real}-wal").stat().st_size > 0

        def all_files() -> int:
            return real.stat().st_size + Path(f"{real}-wal").stat().st_size

        for _ in range(1000):
            if historian.document()["bytes"] == all_files():
                break
            time.sleep(0.01)
        assert historian.document()["bytes"] == all_files()


def test_a_smaller_limit_shrinks_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=8_000_000) as historian:
        for n in range(0, 200_000, 10_000):
            historian.record(numbered(10_000, n))
            until(historian, waiting=0)
    assert path.stat().st_size > 3_000_000
    with history(path, max_size=2_000_000) as historian:
        for _ in range(1000):
            if int(str(historian.document()["bytes"])) <= 2_000_000:
                break
            time.sleep(0.01)
        assert values(historian)[-1] == 199_999
    assert path.stat().st_size <= 2_000_000


def test_what_is_older_than_keep_goes(tmp_path: Path) -> None:
    clock = [NOON + 1000 * SECOND]
    with history(
        tmp_path / "h.db", keep=1.0, max_size=1_000_000, wall=lambda: clock[0]
    ) as historian:
        historian.record(numbered(1500))
        historian.record_write(WriteOutcome("k", 1, WriteResult(1, NOON, 0.1), NOON, 0.1))
        until(historian, waiting=0, writes_stored=1)
        assert values(historian) == list(range(1500))
        for _ in range(1000):
            clock[0] += 10 * SECOND
            if not values(historian) and not list(historian.writes(EVERYTHING)):
                return
            time.sleep(0.01)
    pytest.fail("it never went")


def test_a_clock_that_is_wrong_for_a_moment_costs_little_history(tmp_path: Path) -> None:
    clock = [NOON]
    with history(tmp_path / "h.db", max_size=5_000_000, wall=lambda: clock[0]) as historian:
        historian.record(numbered(30_000))
        until(historian, waiting=0)
        before = len(sorted_runs(tmp_path / "h.db"))
        clock[0] += 10 * 365 * 86400 * SECOND
        historian.record(numbered(100, 30_000))
        until(historian, waiting=0)
        time.sleep(0.3)  # several turns of the writer
        clock[0] = NOON
        assert before >= 4
        assert len(sorted_runs(tmp_path / "h.db")) >= before - 2


def test_what_the_disk_cannot_take_in_time_is_dropped_oldest_first_and_counted(
    tmp_path: Path,
) -> None:
    historian = Historian(tmp_path / "h.db", WEEK, 4_000_000)  # runs of 3906, and nobody writes
    historian.record(numbered(50_000))
    lost = (50_000 // 3906 + 1 - MOST_RUNS) * 3906
    assert historian.document()["lost"] == lost
    for n in range(MOST_WAITING + 7):
        historian.record_write(WriteOutcome("k", n, WriteResult(n, NOON, 0.1), NOON + n, 0.1))
    historian.start()
    document = until(historian, state="ok", waiting=0)
    assert document["lost"] == lost
    assert document["writes_lost"] == 7
    assert values(historian) == list(range(lost, 50_000))
    assert historian.close()


def test_every_write_is_kept_with_its_outcome(tmp_path: Path) -> None:
    done = WriteResult(12.5, NOON, 0.031, verified=True)
    outcomes = [
        WriteOutcome("plant/mixer/speed", 12.5, done, NOON + 2, 0.031, by="abc"),
        WriteOutcome("plant/mixer/run", True, Failure(Problem.REFUSED, "no", "28"), NOON + 1, 0.1),
        WriteOutcome("plant/mixer/x", None, Failure(Problem.UNCLEAR, "\ud800"), NOON + 2, 8.0),
        WriteOutcome(
            "plant/mixer/@stop", None, CommandResult("ok", 1, 0.1), NOON + 3, 0.1, command=True
        ),
    ]
    with history(tmp_path / "h.db") as historian:
        for outcome in outcomes:
            historian.record_write(outcome)
        until(historian, writes_stored=4)
    with history(tmp_path / "h.db") as historian:
        lines = [json.loads(line) for line in historian.writes(EVERYTHING)]
        late = list(historian.writes("[2026-11-21T12:00:00.000000002Z..]", 1))
    assert [line["key"] for line in lines] == [
        "plant/mixer/run",
        "plant/mixer/speed",
        "plant/mixer/x",
        "plant/mixer/@stop",
    ]
    assert lines[0]["outcome"] == "refused"
    assert lines[0]["code"] == "28"
    assert (lines[3]["outcome"], lines[3]["answer"]) == ("obeyed", "ok")
    assert lines[1]["value"] == 12.5
    assert lines[1]["verified"] is True
    assert lines[1]["by"] == "abc"
    assert json.loads(late[0]) == lines[1]


def write(number: int) -> WriteOutcome:
    time = NOON + number * SECOND
    return WriteOutcome("plant/mixer/speed", number, WriteResult(number, time, 0.1), time, 0.1)


def written(historian: Historian, asked: str = EVERYTHING) -> list[int]:
    return [json.loads(line)["value"] for line in historian.writes(asked)]


def test_a_write_is_found_at_once_also_while_the_disk_takes_none(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record_write(write(2))
        historian.record_write(write(4))
        until(historian, writes_stored=2)
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            for number in (5, 1, 3):
                historian.record_write(write(number))
            assert written(historian) == [1, 2, 3, 4, 5]
            assert written(historian, "[2026-11-21T12:00:02Z..2026-11-21T12:00:03Z]") == [2, 3]
            state_with(historian, "another program")
            assert written(historian) == [1, 2, 3, 4, 5]
            other.execute("ROLLBACK")
        until(historian, writes_stored=5)
        assert written(historian) == [1, 2, 3, 4, 5]


def test_questions_see_each_write_once_while_it_moves_to_disk(tmp_path: Path) -> None:
    with history(tmp_path / "h.db") as historian:
        for number in range(500):
            historian.record_write(write(number))
            assert written(historian) == list(range(number + 1))


# -- trouble -----------------------------------------------------------------------------------


def child(do: str, path: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "tests.history_writer", do, str(path)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def told_by(process: "subprocess.Popen[str]") -> dict[str, Any]:
    with process:
        assert process.stdout is not None
        output = process.stdout.read()
    assert process.returncode == 0, output
    told: dict[str, Any] = json.loads(output.splitlines()[-1])
    return told


def state_with(historian: Historian, words: str) -> None:
    """Waits at most 10 s until the state has these words."""
    for _ in range(1000):
        if words in str(historian.document()["state"]):
            return
        time.sleep(0.01)
    raise TimeoutError(f"never {words}: {historian.document()}")


def whole(path: Path) -> bool:
    with closing(sqlite3.connect(path)) as database:
        return list(database.execute("PRAGMA integrity_check")) == [("ok",)]


def test_kill_9_costs_at_most_the_last_moment_and_never_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    at = random.Random(9)
    stored_before = 0
    for _ in range(6):
        process = child("run", path)
        assert process.stdout is not None
        said = [process.stdout.readline()]
        time.sleep(at.uniform(0.05, 0.7))  # any moment
        process.kill()
        killed = time.monotonic_ns()
        said += process.stdout.read().splitlines()
        process.wait()
        process.stdout.close()
        must = [
            int(line.split()[0]) for line in said if killed - int(line.split()[1]) > 200_000_000
        ]
        shutil.copytree(tmp_path, tmp_path.with_name("copy"), dirs_exist_ok=True)
        assert whole(tmp_path.with_name("copy") / "h.db")
        with history(path) as historian:
            for tag in TAGS:
                found = values(historian, tag)[stored_before:]
                assert found == list(range(1, len(found) + 1))  # no hole, none twice
                assert len(found) >= max(must, default=0)
            stored_before += len(found)
            assert not asides(tmp_path)
    assert stored_before > 300


def test_a_disk_that_is_full_is_reported_and_recovers_with_nothing_lost(tmp_path: Path) -> None:
    told = told_by(child("full", tmp_path / "h.db"))
    assert told["trouble"]["state"].startswith("the disk ")
    assert told["after"]["lost"] == 0
    assert told["longest"] < 0.05  # recording does not wait for the disk
    assert whole(tmp_path / "h.db")
    with history(tmp_path / "h.db") as historian:
        for tag in TAGS:
            assert values(historian, tag) == list(range(1, told["number"] + 1))


def test_a_file_that_may_only_be_read_is_reported_and_tried_again(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    path = folder / "h.db"
    with history(path) as historian:
        historian.record(numbered(10))
    path.chmod(0o444)
    folder.chmod(0o555)
    if os.getuid() == 0:
        os.chown(path, NOBODY, NOBODY)
        os.chown(folder, NOBODY, NOBODY)
        for parent in (tmp_path, *tmp_path.parents[:3]):
            if parent.stat().st_mode & 0o011 != 0o011 and parent != Path("/"):
                parent.chmod(0o755)
    told = told_by(child("readonly", path))
    assert "read" in told["trouble"]["state"] or "opened" in told["trouble"]["state"]
    assert told["after"]["lost"] == 0
    with history(path) as historian:
        assert values(historian) == list(range(10))
        assert values(historian, TAGS[3]) == [1]


def test_a_folder_that_comes_late_costs_nothing(tmp_path: Path) -> None:
    historian = Historian(tmp_path / "mounted" / "h.db", WEEK, 10**8)
    historian.start()
    state_with(historian, "the file cannot be opened")
    historian.record(numbered(50))
    with pytest.raises(Busy, match="cannot be opened"):
        historian.samples(SPEED, EVERYTHING, None)
    (tmp_path / "mounted").mkdir()
    until(historian, state="ok", waiting=0)
    assert values(historian) == list(range(50))
    assert historian.close()


def test_a_file_that_was_taken_away_is_begun_again_with_what_is_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(100))
        until(historian, waiting=0)
        for file in tmp_path.iterdir():
            file.unlink()
        for _ in range(1000):
            if path.exists():
                break
            time.sleep(0.01)
        historian.record(numbered(100, 100))
        until(historian, state="ok", waiting=0)
        assert values(historian) == list(range(200))
    with history(path) as historian:
        assert values(historian) == list(range(200))


def test_another_program_that_holds_the_file_only_delays(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(10))
        until(historian, waiting=0)
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            begun = time.perf_counter()
            historian.record(numbered(10, 10))
            assert time.perf_counter() - begun < 0.05
            assert values(historian) == list(range(20))
            state_with(historian, "another program")
            assert values(historian) == list(range(20))
            other.execute("ROLLBACK")
        until(historian, state="ok", waiting=0)
        assert values(historian) == list(range(20))


def asides(folder: Path) -> list[Path]:
    return sorted(folder.glob("h.db.aside-*Z"))


@pytest.mark.parametrize("what", [b"not a database " * 500, b"SQLite format 3\0" + b"\xff" * 5000])
def test_a_file_that_is_no_database_is_moved_aside(tmp_path: Path, what: bytes) -> None:
    path = tmp_path / "h.db"
    path.write_bytes(what)
    with history(path) as historian:
        historian.record(numbered(5))
        assert values(historian) == list(range(5))
    [aside] = asides(tmp_path)
    assert aside.read_bytes() == what


def test_behind_a_link_the_file_is_moved_aside_and_not_the_link(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    path, real = tmp_path / "h.db", disk / "h.db"
    path.symlink_to(real)
    real.write_bytes(b"not a database " * 500)
    with history(path) as historian:
        historian.record(numbered(5))
    assert len(asides(disk)) == 1
    assert path.readlink() == real
    with history(path) as historian:
        assert values(historian) == list(range(5))


def test_a_link_to_itself_is_said_and_waits(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    path.symlink_to(path)
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    state_with(historian, "the file cannot be opened")
    historian.record(numbered(5))
    path.unlink()
    until(historian, state="ok", waiting=0)
    assert historian.close(10)


def test_a_database_of_another_program_is_moved_aside_untouched(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE recipe (name)")
        other.execute("INSERT INTO recipe VALUES ('rye')")
        other.commit()
    before = path.read_bytes()
    with history(path) as historian:
        historian.record(numbered(5))
    [aside] = asides(tmp_path)
    assert aside.read_bytes() == before


def test_a_newer_format_is_moved_aside(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(5))
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 99")
    with history(path) as historian:
        assert values(historian) == []
    assert len(asides(tmp_path)) == 1


def test_damage_that_shows_only_later_is_moved_aside_too(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(30_000))
    with path.open("r+b") as file:
        for page in range(1, path.stat().st_size // 4096):
            file.seek(page * 4096)
            file.write(b"\xa5" * 4096)
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    historian.record(numbered(5))
    until(historian, state="ok", waiting=0)
    assert values(historian) == list(range(5))
    assert historian.close()
    assert len(asides(tmp_path)) == 1


def test_a_page_that_cannot_be_read_is_an_error_not_an_empty_answer(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=5_000_000) as historian:
        historian.record(numbered(30_000))
    with history(path, max_size=5_000_000):
        pass  # all runs are sorted now
    with closing(sqlite3.connect(path)) as database:
        [(root,)] = database.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'sample'")
    with path.open("r+b") as file:
        file.seek((root - 1) * 4096)
        file.write(b"\xa5" * 4096)
    historian = Historian(path, WEEK, 5_000_000)
    historian.start()
    until(historian, state="ok")
    with pytest.raises(Busy, match="cannot be read"):
        values(historian)
    assert historian.close()


def test_an_unfinished_run_of_an_earlier_life_is_sorted_at_the_start(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(100))
    assert sorted_runs(path) == []
    with history(path) as historian:
        historian.record(numbered(100, 100))
        assert values(historian) == list(range(200))
    assert sorted_runs(path) == [(1, 100)]
    with closing(HistoryFile(path, 10**8)) as file:
        assert file.unsorted() == {2: (NOON + 100 * SECOND, NOON + 199 * SECOND, 100)}


# -- another gateway, another file -------------------------------------------------------------


def test_a_second_gateway_leaves_the_file_alone_until_the_first_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=SMALL) as first:
        first.record(numbered(100))
        until(first, waiting=0)
        second = Historian(path, WEEK, SMALL)
        second.start()
        second.record(numbered(100, 5000))
        state_with(second, "another gateway writes this file")
        with pytest.raises(Busy, match="another gateway"):
            second.samples(SPEED, EVERYTHING, None)
        first.record(numbered(3900, 100))
        until(first, waiting=0)
        assert values(first) == list(range(4000))
        assert first.document()["lost"] == 0
        assert second.document()["stored"] == 0
    until(second, state="ok", waiting=0)
    assert values(second) == [*range(4000), *range(5000, 5100)]
    assert second.close()


def test_a_gateway_that_is_killed_lets_go_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    process = child("run", path)
    assert process.stdout is not None
    while not path.exists():
        process.stdout.readline()
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    state_with(historian, "another gateway writes this file")
    process.kill()
    process.stdout.close()
    process.wait()
    until(historian, state="ok")
    assert historian.close()


def test_the_lock_holds_over_nfs_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There it is one of a range of bytes, which a file that is only read cannot have."""

    def flock(file: int, how: int) -> None:
        fcntl.lockf(file, how)

    monkeypatch.setattr(lock.fcntl, "flock", flock)
    path = tmp_path / "h.db"
    file = lock.locked(path)
    command = (
        "import fcntl, sys; fcntl.lockf(open(sys.argv[1], 'r+'), fcntl.LOCK_EX | fcntl.LOCK_NB)"
    )
    another = [sys.executable, "-c", command, f"{path}.lock"]
    assert b"BlockingIOError" in subprocess.run(another, capture_output=True, check=False).stderr
    os.close(file)
    assert subprocess.run(another, capture_output=True, check=False).stderr == b""


def test_where_the_disk_has_no_locks_history_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def take(file: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock, "_take", take)
    with history(tmp_path / "h.db") as historian:
        historian.record(numbered(5))
        until(historian, waiting=0)


def test_a_file_opens_in_which_a_run_was_sorted_before_its_end(tmp_path: Path) -> None:
    """As two gateways that wrote one file have left it."""
    path = tmp_path / "h.db"
    with closing(HistoryFile(path, 10**8)) as file:
        file.store(1, 0, numbered(100))
        file.sort(1, NOON)
        file.store(1, 100, numbered(100, 100))
    with history(path) as historian:
        assert values(historian) == list(range(200))
    assert sorted_runs(path) == [(1, 200)]


@pytest.mark.parametrize("ended_well", [True, False])
def test_an_older_file_put_in_place_takes_what_is_in_memory(
    tmp_path: Path, ended_well: bool
) -> None:
    path, older = tmp_path / "h.db", tmp_path / "older.db"
    with closing(HistoryFile(older, 10**8)) as file:
        file.store(1, 0, numbered(200))
        if ended_well:
            file.sort(1, NOON)
    with history(path) as historian:
        historian.record(numbered(50, 1000))
        until(historian, waiting=0)
        older.replace(path)
        until(historian, stored=100)  # once here and once there
        historian.record(numbered(50, 1050))
        until(historian, state="ok", waiting=0)
        assert values(historian) == [*range(200), *range(1000, 1100)]
        assert historian.document()["lost"] == 0
    with history(path) as historian:
        assert values(historian) == [*range(200), *range(1000, 1100)]


def test_an_older_copy_in_place_and_then_the_newer_again_lose_nothing(tmp_path: Path) -> None:
    """Both are the same file by their identity, and number 2 is another run in each."""
    path, older, newer = tmp_path / "h.db", tmp_path / "older.db", tmp_path / "newer.db"
    with closing(HistoryFile(path, 10**8)) as file:
        file.store(1, 0, numbered(100))
        file.sort(1, NOON)
    shutil.copy(path, older)
    with closing(HistoryFile(path, 10**8)) as file:
        file.store(2, 0, numbered(50, 100))
        file.sort(2, NOON)
    with history(path) as historian:
        historian.record(numbered(50, 1000))
        until(historian, waiting=0)
        path.rename(newer)
        older.rename(path)
        until(historian, stored=100)
        newer.replace(path)
        until(historian, stored=150)
        historian.record(numbered(50, 1050))
        until(historian, state="ok", waiting=0)
        assert set(values(historian)) == {*range(150), *range(1000, 1100)}
    with history(path) as historian:
        assert set(values(historian)) == {*range(150), *range(1000, 1100)}


def test_an_answer_never_has_the_values_of_another_tag(tmp_path: Path) -> None:
    """Tags and runs have the same numbers in two files, only that the tags are swapped."""
    path, other = tmp_path / "h.db", tmp_path / "other.db"
    for file_path, tags in ((path, (SPEED, DOOR)), (other, (DOOR, SPEED))):
        with closing(HistoryFile(file_path, 10**8)) as file:
            for run in (1, 2, 3):
                for n, of in enumerate(tags):
                    times = range(NOON + run * SECOND, NOON + (run + 1) * SECOND, SECOND // 10)
                    file.store(run, 10 * n, [good(of, of.name, time) for time in times])
                file.sort(run, NOON)
    with history(path) as historian:
        historian.record(numbered(1, 1000, tag("level")))
        until(historian, waiting=0)
        answer = historian.samples(SPEED, EVERYTHING, None)
        found = [next(answer).value]
        other.replace(path)
        until(historian, state="ok", stored=2)  # once here and once there
        with pytest.raises(Busy, match="another file"):
            found.extend(sample.value for sample in answer)
        assert found == ["speed"] * len(found)
        assert values(historian) == ["speed"] * 30


def test_a_file_that_nobody_has_noticed_yet_answers_no_question_about_the_one_before(
    tmp_path: Path,
) -> None:
    path = tmp_path / "h.db"
    everything = TimeRange(EARLIEST, LATEST)
    with closing(HistoryFile(path, 10**8)) as file:
        file.store(1, 0, numbered(10))
        run = file.sort(1, NOON)
        assert run is not None
        reader = Reader(path)
        assert len(reader.samples(file.identity, SPEED, run, everything, None) or []) == 10
        another = Identity(file.identity.inode, b"another")
        with pytest.raises(Busy, match="another file"):
            reader.samples(another, SPEED, run, everything, None)
        with pytest.raises(Busy, match="another file"):
            next(reader.writes(another, 1, everything))
        shutil.copy(path, tmp_path / "copy.db")
        (tmp_path / "copy.db").replace(path)
        with pytest.raises(Busy, match="another file"):
            reader.samples(file.identity, SPEED, run, everything, None)


def test_a_file_from_before_files_had_an_identity_is_given_one(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(5))
    with closing(sqlite3.connect(path)) as database:
        database.execute("DROP TABLE file")
    with history(path) as historian:
        assert values(historian) == list(range(5))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_history_that_fails_in_an_unforeseen_way_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        monkeypatch.setattr(HistoryFile, "store", lambda *_: 1 // 0)
        historian.record(numbered(5))
        state_with(historian, "history has failed: start the gateway again")
        historian.record(numbered(5, 5))
        assert values(historian) == list(range(10))
    monkeypatch.undo()
    with history(path) as historian:  # nobody holds the file
        assert values(historian) == []
