"""Outcomes of writes: kept, found at once, each once."""

import json
import sqlite3
import time
from contextlib import closing
from pathlib import Path

from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import CommandResult
from gateway.tags import WriteResult
from tests.history.recorded import (
    EVERYTHING,
    NOON,
    history,
    record_outcome,
    wait_for_state,
    write,
    written,
)
from tests.history_writer import until


def test_outcomes_are_kept_in_the_order_of_their_time(tmp_path: Path) -> None:
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
            record_outcome(historian, outcome)
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


def test_an_outcome_is_found_while_the_disk_accepts_none(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        record_outcome(historian, write(2))
        record_outcome(historian, write(4))
        until(historian, writes_stored=2)
        with closing(sqlite3.connect(path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            for number in (5, 1, 3):
                record_outcome(historian, write(number))
            assert written(historian) == [1, 2, 3, 4, 5]
            assert written(historian, "[2026-11-21T12:00:02Z..2026-11-21T12:00:03Z]") == [2, 3]
            wait_for_state(historian, "another program")
            assert written(historian) == [1, 2, 3, 4, 5]
            other.execute("ROLLBACK")
        until(historian, writes_stored=5)
        assert written(historian) == [1, 2, 3, 4, 5]


def test_queries_see_each_outcome_once_while_it_moves_to_disk(tmp_path: Path) -> None:
    with history(tmp_path / "h.db") as historian:
        for number in range(500):
            record_outcome(historian, write(number))
            assert written(historian) == list(range(number + 1))


def test_refusals_push_out_no_write(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path, max_size=10**6) as historian:
        for number in range(20):
            record_outcome(historian, write(number))
        for number in range(20, 1000):
            record_outcome(historian, write(number), refused=True)
        until(historian, writes_stored=20, refusals_stored=980)
        assert written(historian) == [*range(20), *range(900, 1000)]
        record_outcome(historian, write(1000))
        assert written(historian)[-2:] == [999, 1000]  # in the order of time, also from memory


def test_changes_of_alarms_have_a_ring_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "h.db"
    with history(path) as historian:
        record_outcome(historian, write(1))
        until(historian, writes_stored=1)
    with history(path) as historian:
        historian.record_alarm(time.time_ns(), '{"event": "raised"}')
        assert [*historian.alarms("[..]")] == ['{"event": "raised"}']
        until(historian, alarms_stored=1)
        historian.record_alarm(time.time_ns(), '{"event": "ended"}')
        assert [*historian.alarms("[..]", 1)] == ['{"event": "raised"}']
        assert len([*historian.alarms("[..]")]) == 2
        assert written(historian) == [1]
