"""A historian with its file, and samples to record in it."""

import json
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from gateway.contract import payload
from gateway.contract.payload import WriteOutcome
from gateway.parts.history.answers.recent import SortedRun
from gateway.parts.history.historian import Historian
from gateway.parts.history.store.file import HistoryFile, oldest
from gateway.tags import Sample, Tag, WriteResult, good
from gateway.values import Value
from tests.history_writer import tag, until

SPEED, DOOR = tag("speed"), tag("door")
SECOND = 10**9
NOON = 1_795_262_400 * SECOND  # 2026-11-21T12:00:00Z
DECADES = 50 * 365 * 86_400.0  # seconds: the tests of retention say their own time
EVERYTHING = "[..]"
SMALL = 2_000_000  # bytes: makes runs of 1953 samples


@contextmanager
def history(
    path: Path, keep: float = DECADES, max_size: int = 10**8, **how: Any
) -> Iterator[Historian]:
    historian = Historian(path, keep, max_size, **how)
    historian.start()
    try:
        until(historian, state="ok")
        yield historian
    finally:
        assert historian.close(60)


def record_outcome(historian: Historian, outcome: WriteOutcome, *, refused: bool = False) -> None:
    text = payload.write_outcome(outcome).decode()
    historian.record_write(outcome.time, text, refused=refused)


def values(
    historian: Historian, tag: Tag = SPEED, time_range: str = EVERYTHING
) -> list[Value | None]:
    return [sample.value for sample in historian.samples(tag, time_range, None)]


def numbered(count: int, start: int = 0, tag: Tag = SPEED) -> Sequence[Sample]:
    return [good(tag, n, NOON + n * SECOND) for n in range(start, start + count)]


def store_run(file: HistoryFile, samples: Sequence[Sample], now: int = NOON) -> SortedRun:
    """Stores samples as a run of their own."""
    number = file.next_number()
    file.store(number, samples)
    run = file.close_run(number, number + len(samples), now)
    assert run is not None
    return run


def all_runs(file: HistoryFile) -> list[SortedRun]:
    return file.closed_runs(NOON, file.next_number())


def closed_runs(path: Path) -> list[tuple[int, int]]:
    with closing(sqlite3.connect(path)) as database:
        return list(database.execute("SELECT id, samples FROM run ORDER BY id"))


def oldest_in_file(path: Path) -> int:
    """Returns the number of the oldest sample that the file still has."""
    with closing(sqlite3.connect(path)) as database:
        return oldest(database)


def write(number: int) -> WriteOutcome:
    time = NOON + number * SECOND
    return WriteOutcome("plant/mixer/speed", number, WriteResult(number, time, 0.1), time, 0.1)


def written(historian: Historian, time_range: str = EVERYTHING) -> list[int]:
    return [json.loads(line)["value"] for line in historian.writes(time_range)]


def start_writer(do: str, path: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "tests.history_writer", do, str(path)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def result_of(process: "subprocess.Popen[str]") -> dict[str, Any]:
    with process:
        assert process.stdout is not None
        output = process.stdout.read()
    assert process.returncode == 0, output
    result: dict[str, Any] = json.loads(output.splitlines()[-1])
    return result


def wait_for_state(historian: Historian, words: str) -> None:
    """Waits at most 10 s until the state has these words."""
    for _ in range(1000):
        if words in str(historian.document()["state"]):
            return
        time.sleep(0.01)
    raise TimeoutError(f"never {words}: {historian.document()}")


def is_intact(path: Path) -> bool:
    with closing(sqlite3.connect(path)) as database:
        return list(database.execute("PRAGMA integrity_check")) == [("ok",)]


def moved_aside(folder: Path) -> list[Path]:
    return sorted(folder.glob("h.db.aside-*Z"))
