"""The lock: one gateway writes the file."""

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.errors import Busy
from gateway.parts.history.historian import Historian
from gateway.parts.history.store import lock
from tests.history.recorded import (
    EVERYTHING,
    SMALL,
    SPEED,
    history,
    numbered,
    start_writer,
    values,
    wait_for_state,
)
from tests.history_writer import WEEK, until


def test_a_second_gateway_waits_until_the_first_has_ended(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=SMALL) as first:
        first.record(numbered(100))
        until(first, waiting=0)
        second = Historian(path, WEEK, SMALL)
        second.start()
        second.record(numbered(100, 5000))
        wait_for_state(second, "another gateway writes this file")
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


def test_a_killed_gateway_releases_the_file(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    process = start_writer("run", path)
    assert process.stdout is not None
    while not path.exists():
        process.stdout.readline()
    historian = Historian(path, WEEK, 10**8)
    historian.start()
    wait_for_state(historian, "another gateway writes this file")
    process.kill()
    process.stdout.close()
    process.wait()
    until(historian, state="ok")
    assert historian.close()


def test_the_lock_holds_over_nfs_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NFS maps it to a lock on a range of bytes, which needs a file open for writing."""

    def flock(file: int, how: int) -> None:
        fcntl.lockf(file, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    path = tmp_path / "h.db"
    file = lock.locked(path)
    command = (
        "import fcntl, sys; fcntl.lockf(open(sys.argv[1], 'r+'), fcntl.LOCK_EX | fcntl.LOCK_NB)"
    )
    another = [sys.executable, "-c", command, f"{path}.lock"]
    assert b"BlockingIOError" in subprocess.run(another, capture_output=True, check=False).stderr
    os.close(file)
    assert subprocess.run(another, capture_output=True, check=False).stderr == b""


def test_on_a_disk_without_locks_history_is_written_nevertheless(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(file: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    with history(tmp_path / "h.db") as historian:
        historian.record(numbered(5))
        until(historian, waiting=0)
