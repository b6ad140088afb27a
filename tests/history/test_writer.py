"""Failures of the disk: reported, survived, and nothing lost that the rules keep."""

import os
import random
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

from gateway.errors import Busy
from gateway.parts.history.historian import Historian
from gateway.parts.history.store.file import HistoryFile
from tests.history.recorded import (
    EVERYTHING,
    SPEED,
    history,
    is_intact,
    moved_aside,
    numbered,
    result_of,
    start_writer,
    values,
    wait_for_state,
)
from tests.history_writer import NOBODY, TAGS, WEEK, until


def test_kill_9_costs_nothing_that_is_said_to_be_stored_and_never_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    at = random.Random(9)
    stored_before = 0
    for _ in range(6):
        process = start_writer("run", path)
        assert process.stdout is not None
        output = [process.stdout.readline()]
        time.sleep(at.uniform(0.05, 0.7))  # any moment
        process.kill()
        output += process.stdout.read().splitlines()
        process.wait()
        process.stdout.close()
        must = [int(line) for line in output]
        shutil.copytree(tmp_path, tmp_path.with_name("copy"), dirs_exist_ok=True)
        assert is_intact(tmp_path.with_name("copy") / "h.db")
        with history(path) as historian:
            for tag in TAGS:
                found = values(historian, tag)[stored_before:]
                assert found == list(range(1, len(found) + 1))  # no hole, none twice
                assert len(found) >= max(must, default=0)
            stored_before += len(found)
            assert not moved_aside(tmp_path)
    assert stored_before > 0


def test_a_full_disk_is_reported_and_costs_no_sample(tmp_path: Path) -> None:
    result = result_of(start_writer("full", tmp_path / "h.db"))
    assert result["trouble"]["state"].startswith("the disk ")
    assert result["after"]["lost"] == 0
    assert result["longest"] < 0.05  # recording does not wait for the disk
    assert is_intact(tmp_path / "h.db")
    with history(tmp_path / "h.db") as historian:
        for tag in TAGS:
            assert values(historian, tag) == list(range(1, result["number"] + 1))


def test_a_read_only_file_is_reported_and_tried_again(tmp_path: Path) -> None:
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
    result = result_of(start_writer("readonly", path))
    assert "read" in result["trouble"]["state"] or "opened" in result["trouble"]["state"]
    assert result["after"]["lost"] == 0
    with history(path) as historian:
        assert values(historian) == list(range(10))
        assert values(historian, TAGS[3]) == [1]


def test_a_folder_that_is_mounted_late_costs_no_sample(tmp_path: Path) -> None:
    historian = Historian(tmp_path / "mounted" / "h.db", WEEK, 10**8)
    historian.start()
    wait_for_state(historian, "the file cannot be opened")
    historian.record(numbered(50))
    with pytest.raises(Busy, match="cannot be opened"):
        historian.samples(SPEED, EVERYTHING, None)
    (tmp_path / "mounted").mkdir()
    until(historian, state="ok", waiting=0)
    assert values(historian) == list(range(50))
    assert historian.close()


def test_a_deleted_file_is_created_again_with_the_samples_in_memory(tmp_path: Path) -> None:
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
            wait_for_state(historian, "another program")
            assert values(historian) == list(range(20))
            other.execute("ROLLBACK")
        until(historian, state="ok", waiting=0)
        assert values(historian) == list(range(20))


@pytest.mark.parametrize("what", [b"not a database " * 500, b"SQLite format 3\0" + b"\xff" * 5000])
def test_a_file_that_is_no_database_is_moved_aside(tmp_path: Path, what: bytes) -> None:
    path = tmp_path / "h.db"
    path.write_bytes(what)
    with history(path) as historian:
        historian.record(numbered(5))
        assert values(historian) == list(range(5))
    [aside] = moved_aside(tmp_path)
    assert aside.read_bytes() == what


def test_behind_a_symbolic_link_the_file_is_moved_aside_and_not_the_link(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    path, real = tmp_path / "h.db", disk / "h.db"
    path.symlink_to(real)
    real.write_bytes(b"not a database " * 500)
    with history(path) as historian:
        historian.record(numbered(5))
    assert len(moved_aside(disk)) == 1
    assert path.readlink() == real
    with history(path) as historian:
        assert values(historian) == list(range(5))


def test_a_link_to_itself_is_reported_and_tried_again(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    path.symlink_to(path)
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    wait_for_state(historian, "the file cannot be opened")
    historian.record(numbered(5))
    path.unlink()
    until(historian, state="ok", waiting=0)
    assert historian.close(60)


def test_a_database_of_another_program_is_moved_aside_untouched(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE recipe (name)")
        other.execute("INSERT INTO recipe VALUES ('rye')")
        other.commit()
    before = path.read_bytes()
    with history(path) as historian:
        historian.record(numbered(5))
    [aside] = moved_aside(tmp_path)
    assert aside.read_bytes() == before


def test_a_newer_format_is_moved_aside(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        historian.record(numbered(5))
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 99")
    with history(path) as historian:
        assert values(historian) == []
    assert len(moved_aside(tmp_path)) == 1


def test_damage_found_later_is_moved_aside_too(tmp_path: Path) -> None:
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
    assert len(moved_aside(tmp_path)) == 1


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bug_in_the_writer_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        monkeypatch.setattr(HistoryFile, "store", lambda *_: 1 // 0)
        historian.record(numbered(5))
        wait_for_state(historian, "history has failed: start the gateway again")
        historian.record(numbered(5, 5))
        assert values(historian) == list(range(10))
    monkeypatch.undo()
    with history(path) as historian:  # the lock is released
        assert values(historian) == []
