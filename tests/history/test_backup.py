"""A copy of the history while it is written, and its restoration."""

import os
import sqlite3
import stat
import threading
from contextlib import closing
from pathlib import Path

import pytest

from gateway.errors import GatewayError
from gateway.parts.history.files.offline import backup
from gateway.parts.history.store.place import trouble
from tests.history.recorded import SMALL, history, is_intact, numbered, values
from tests.history_writer import until

COUNT = 3000


def test_a_copy_is_the_state_of_one_moment_while_samples_are_stored(tmp_path: Path) -> None:
    file, copy = tmp_path / "h.db", tmp_path / "copy.db"
    with history(file, max_size=SMALL) as historian:
        historian.record(numbered(COUNT))
        until(historian, stored=COUNT)
        ended = threading.Event()

        def record() -> None:
            for number in range(COUNT, 3 * COUNT, 10):  # runs are sorted meanwhile
                historian.record(numbered(10, number))
                ended.wait(0.001)

        recording = threading.Thread(target=record)
        recording.start()
        try:
            backup(file, copy)
        finally:
            ended.set()
            recording.join()
    assert is_intact(copy)
    assert stat.S_IMODE(copy.stat().st_mode) == 0o600
    # Restored, as docs/deployment.md has it: in the place of the file, without its log.
    for old in tmp_path.glob("h.db*"):
        old.unlink()
    copy.rename(file)
    with history(file) as historian:
        found = values(historian)
        assert COUNT <= len(found) <= 3 * COUNT
        assert found == list(range(len(found)))
        historian.record(numbered(1, 10**6))
        assert values(historian)[-1] == 10**6


def test_a_copy_replaces_nothing_and_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.parts.history.files.offline.BUSY_WITHIN", 0.0)
    file, copy = tmp_path / "h.db", tmp_path / "copy.db"
    with pytest.raises(GatewayError, match="there is no history"):
        backup(file, copy)
    with history(file):
        pass
    copy.write_text("yesterday")
    with pytest.raises(GatewayError, match="exists: name a new file"):
        backup(file, copy)
    assert copy.read_text() == "yesterday"
    with pytest.raises(GatewayError, match=r"was not copied to .*No such file"):
        backup(file, tmp_path / "missing" / "copy.db")
    with closing(sqlite3.connect(tmp_path / "held.db")) as held:
        held.execute("CREATE TABLE t (x)")
        held.execute("BEGIN EXCLUSIVE")
        with pytest.raises(GatewayError, match="another program holds the file"):
            backup(tmp_path / "held.db", tmp_path / "new.db")
    assert not list(tmp_path.glob("*.unfinished"))


def test_a_place_is_tried_without_a_trace(tmp_path: Path) -> None:
    file = tmp_path / "h.db"
    assert trouble(file) is None
    assert list(tmp_path.iterdir()) == []
    assert trouble(tmp_path) == "it is no file"
    assert trouble(tmp_path / "missing" / "h.db") == f"there is no folder {tmp_path / 'missing'}"
    assert "/proc/self: " in str(trouble(Path("/proc/self/h.db"))).replace(str(os.getpid()), "self")
    link = tmp_path / "link"
    link.symlink_to(file)
    file.touch()
    assert trouble(link) is None
