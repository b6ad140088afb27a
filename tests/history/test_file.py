"""The file across restarts, and other files in its place."""

import shutil
from contextlib import closing
from pathlib import Path

import pytest

from gateway.parts.history.store.file import HistoryFile
from tests.history.recorded import NOON, SECOND, closed_runs, history, numbered, store_run, values
from tests.history_writer import until


def test_a_run_of_an_earlier_process_gets_its_index_at_the_start(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(100))
    assert closed_runs(path) == []
    with history(path) as historian:
        historian.record(numbered(100, 100))
        assert values(historian) == list(range(200))
    assert closed_runs(path) == [(1, 100)]
    with closing(HistoryFile(path, 10**8)) as file:
        assert file.extent(101, 1000) == (NOON + 100 * SECOND, NOON + 199 * SECOND, 100)


@pytest.mark.parametrize("ended_well", [True, False])
def test_an_older_file_in_its_place_gets_the_samples_in_memory(
    tmp_path: Path, ended_well: bool
) -> None:
    path, older = tmp_path / "h.db", tmp_path / "older.db"
    with closing(HistoryFile(older, 10**8)) as file:
        file.store(1, numbered(200))
        if ended_well:
            file.close_run(1, 201, NOON)
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
        store_run(file, numbered(100))
    shutil.copy(path, older)
    with closing(HistoryFile(path, 10**8)) as file:
        store_run(file, numbered(50, 100))
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
