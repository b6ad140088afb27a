"""The limits of the file: size, age, and the runs in memory."""

import time
from contextlib import suppress
from pathlib import Path

import pytest

from gateway.contract.past.timerange import time_range
from gateway.contract.payload import WriteOutcome
from gateway.errors import Busy
from gateway.parts.history.answers.outcomes import MOST_WAITING
from gateway.parts.history.answers.recent import MOST_RUNS, SortedRun
from gateway.parts.history.historian import Historian
from gateway.parts.history.store.transfer import age
from gateway.tags import WriteResult, good
from tests.history.recorded import (
    EVERYTHING,
    NOON,
    SECOND,
    SPEED,
    closed_runs,
    history,
    numbered,
    record_outcome,
    values,
)
from tests.history_writer import WEEK, until


def test_a_full_file_drops_the_oldest_first(tmp_path: Path) -> None:
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


def test_the_size_of_the_log_counts_behind_a_symbolic_link(tmp_path: Path) -> None:
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
        last = None
        while last is None:
            with suppress(Busy):  # runs are still dropped
                last = values(historian)[-1]
        assert last == 199_999
    assert path.stat().st_size <= 2_000_000


def test_samples_older_than_keep_are_dropped(tmp_path: Path) -> None:
    clock = [NOON + 1000 * SECOND]
    with history(
        tmp_path / "h.db", keep=1.0, max_size=1_000_000, wall=lambda: clock[0]
    ) as historian:
        historian.record(good(SPEED, n, clock[0] + n) for n in range(1500))
        record_outcome(historian, WriteOutcome("k", 1, WriteResult(1, NOON, 0.1), NOON, 0.1))
        until(historian, waiting=0, writes_stored=1)
        assert values(historian) == list(range(1500))
        for _ in range(1000):
            clock[0] += 10 * SECOND
            if not values(historian) and not list(historian.writes(EVERYTHING)):
                return
            time.sleep(0.01)
    pytest.fail("it never went")


DAY = 86400 * SECOND
YEARS = 3650 * DAY


def ten_minutes(number: int, ahead: int = 0) -> SortedRun:
    first = NOON + number * 600 * SECOND + ahead
    return SortedRun(1 + 100 * number, first, first + 599 * SECOND, 100, first + 600 * SECOND)


@pytest.mark.parametrize("ahead", [YEARS, -YEARS, 2 * DAY])
def test_one_clock_makes_nothing_old(ahead: int) -> None:
    runs = [ten_minutes(number) for number in range(6 * 24 * 6)]  # six days
    now, week = runs[-1].last + SECOND, 7 * DAY
    assert age(runs, now, week) == 6 * DAY - 599 * SECOND
    assert age(runs, now + ahead, week) <= 6 * DAY + week // 10  # it is wrong now
    back = [*runs, ten_minutes(len(runs), ahead), ten_minutes(len(runs) + 1)]
    assert age(back, back[-1].last, week) < 6 * DAY + 3600 * SECOND  # it was wrong
    within = runs[100]._replace(last=runs[100].last + ahead)
    assert age([*runs[:100], within, *runs[101:]], now, week) < 6 * DAY + 3600 * SECOND


def test_a_gateway_that_was_off_for_long_loses_its_history_little_by_little() -> None:
    runs = [ten_minutes(0), *(ten_minutes(number) for number in range(10_000, 10_100))]
    assert DAY // 2 < age(runs, runs[-1].last, 7 * DAY) < 2 * DAY


@pytest.mark.parametrize("back", [True, False])
def test_a_clock_ten_years_ahead_for_a_moment_costs_nothing(tmp_path: Path, *, back: bool) -> None:
    clock = [NOON + 40_000 * SECOND]
    with history(tmp_path / "h.db", max_size=5_000_000, wall=lambda: clock[0]) as historian:
        historian.record(numbered(30_000))
        record_outcome(historian, WriteOutcome("k", 1, WriteResult(1, NOON, 0.1), NOON, 0.1))
        until(historian, waiting=0, writes_stored=1)
        before = len(closed_runs(tmp_path / "h.db"))
        assert before >= 4
        clock[0] += YEARS
        historian.record(good(SPEED, n, clock[0] + n) for n in range(30_000, 36_000))
        until(historian, waiting=0)
        if back:
            clock[0] -= YEARS
            historian.record(good(SPEED, n, clock[0] + n) for n in range(36_000, 42_000))
            until(historian, waiting=0)
        assert len(closed_runs(tmp_path / "h.db")) > before
        assert set(range(36_000)) <= set(values(historian))
        assert len([*historian.writes(EVERYTHING)]) == 1


def test_samples_that_the_disk_cannot_take_are_dropped_oldest_first_and_counted(
    tmp_path: Path,
) -> None:
    historian = Historian(
        tmp_path / "h.db", WEEK, 4_000_000
    )  # runs of 3906; the writer is not started yet
    historian.record(numbered(50_000))
    lost = (50_000 // 3906 + 1 - MOST_RUNS) * 3906
    assert historian.document()["lost"] == lost
    for n in range(MOST_WAITING + 7):
        record_outcome(historian, WriteOutcome("k", n, WriteResult(n, NOON, 0.1), NOON + n, 0.1))
    historian.start()
    document = until(historian, state="ok", waiting=0)
    assert document["lost"] == lost
    assert document["writes_lost"] == 7
    assert values(historian) == list(range(lost, 50_000))
    assert historian.close()
