"""Answers: complete, in the order of time, and from one file."""

import shutil
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange
from gateway.errors import Busy
from gateway.parts.history.answers.outcomes import Outcome, Ring
from gateway.parts.history.answers.recent import Identity
from gateway.parts.history.store.file import HistoryFile
from gateway.parts.history.store.reader import Reader, SampleSource, in_order
from gateway.tags import Sample, good
from tests.history.recorded import (
    DOOR,
    EVERYTHING,
    NOON,
    SECOND,
    SPEED,
    history,
    moved_aside,
    numbered,
    store_run,
    values,
)
from tests.history_writer import tag, until


@given(st.lists(st.lists(st.integers(0, 50), max_size=8), max_size=8))
def test_overlapping_parts_are_merged_by_time(times: list[list[int]]) -> None:
    runs = [
        sorted((good(SPEED, n, t) for t in run), key=lambda s: s.time)
        for n, run in enumerate(times)
    ]
    parts = [SampleSource(run[0].time if run else 0, partial(iter, run)) for run in runs]
    expected = sorted((sample for run in runs for sample in run), key=lambda s: (s.time, s.value))
    assert list(in_order(parts)) == expected


def test_a_part_is_read_only_when_its_time_comes() -> None:
    read: list[int] = []

    def part(first: int) -> SampleSource:
        def samples() -> list[Sample]:
            read.append(first)
            return [good(SPEED, first, first)]

        return SampleSource(first, samples)

    answers = in_order([part(first) for first in range(100)])
    assert [next(answers).value for _ in range(3)] == [0, 1, 2]
    assert read == [0, 1, 2]


def test_a_number_is_used_once(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with closing(HistoryFile(path, 10**8)) as file:
        before = store_run(file, numbered(10))
        file.drop(before)
        after = store_run(file, numbered(10, 10))
        assert after.number == before.end
        reader = Reader(path)
        assert reader.rows(file.identity, before, range(10)) is None
        rows, lost = reader.rows(file.identity, after, range(10)) or ([], True)
        assert (len(rows), lost) == (10, False)


def test_writes_that_are_dropped_during_an_answer_end_it_with_an_error(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    everything = TimeRange(EARLIEST, LATEST)
    with closing(HistoryFile(path, 10**8)) as file:
        outcomes = [Outcome(NOON + n, str(n)) for n in range(2500)]
        last = file.store_writes(Ring.WRITTEN, outcomes, 2500)
        answer = Reader(path).writes(Ring.WRITTEN, file.identity, last, everything)
        found = [next(answer).text for _ in range(10)]
        assert file.store_writes(Ring.WRITTEN, [Outcome(NOON + 2500, "2500")], 500) == 2501
        with pytest.raises(Busy, match="dropped meanwhile"):
            found.extend(outcome.text for outcome in answer)
        assert found == [str(n) for n in range(len(found))]


def test_an_answer_never_has_the_values_of_another_tag(tmp_path: Path) -> None:
    """Tags and runs have the same numbers in two files, only that the tags are swapped."""
    path, other = tmp_path / "h.db", tmp_path / "other.db"
    for file_path, tags in ((path, (SPEED, DOOR)), (other, (DOOR, SPEED))):
        with closing(HistoryFile(file_path, 10**8)) as file:
            for run in (1, 2, 3):
                times = range(NOON + run * SECOND, NOON + (run + 1) * SECOND, SECOND // 10)
                store_run(file, [good(of, of.name, time) for of in tags for time in times])
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


def test_a_file_that_has_just_been_replaced_answers_no_query(
    tmp_path: Path,
) -> None:
    path = tmp_path / "h.db"
    everything = TimeRange(EARLIEST, LATEST)
    with closing(HistoryFile(path, 10**8)) as file:
        run = store_run(file, numbered(10))
        reader = Reader(path)
        listed = range(10)
        assert reader.rows(file.identity, run, listed)
        another = Identity(file.identity.inode, b"another")
        with pytest.raises(Busy, match="another file"):
            reader.rows(another, run, listed)
        with pytest.raises(Busy, match="another file"):
            next(reader.writes(Ring.WRITTEN, another, 1, everything))
        shutil.copy(path, tmp_path / "copy.db")
        (tmp_path / "copy.db").replace(path)
        with pytest.raises(Busy, match="another file"):
            reader.rows(file.identity, run, listed)


def test_a_table_that_cannot_be_read_is_moved_aside(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=5_000_000) as historian:
        historian.record(numbered(30_000))
    with history(path, max_size=5_000_000):
        pass
    with closing(sqlite3.connect(path)) as database:
        [(root,)] = database.execute("SELECT rootpage FROM sqlite_schema WHERE name = 'sample'")
    with path.open("r+b") as file:
        file.seek((root - 1) * 4096)
        file.write(b"\xa5" * 4096)
    with history(path, max_size=5_000_000) as historian:
        historian.record(numbered(5))
        assert values(historian) == list(range(5))
    assert len(moved_aside(tmp_path)) == 1
