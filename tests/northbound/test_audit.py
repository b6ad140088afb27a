"""The audit under a flood of refused writes."""

import json
from dataclasses import replace

import pytest
import structlog

from gateway.contract import audited
from gateway.contract.payload import WriteOutcome
from gateway.contract.problems import Failure, Problem
from gateway.contract.rate_limit import RateLimit
from gateway.engine.jobs.requests import CommandResult
from gateway.northbound.requests.audit import BURST, Audit
from gateway.tags import WriteResult


def outcome(result: WriteResult | CommandResult | Failure, number: int = 0) -> WriteOutcome:
    return WriteOutcome("plant/mixer/recipe", number, result, number, 0.0, None)


def test_a_flood_of_refusals_is_counted_while_sent_writes_are_all_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gateway.northbound.requests.audit.EVERY", 1e9)  # none while it runs
    published: list[bytes] = []
    recorded: list[tuple[int, str]] = []
    rings: list[bool] = []

    def record(time: int, text: str, *, refused: bool) -> None:
        recorded.append((time, text))
        rings.append(refused)

    audit = Audit(published.append, record)
    with structlog.testing.capture_logs() as lines:
        for number in range(10_000):
            audit(outcome(Failure(Problem.UNKNOWN_TAG, "no"), number))
        for ending in (
            WriteResult(1, 0, took=0.1),
            Failure(Problem.UNCLEAR, "?"),
            Failure(Problem.REFUSED, "no", "28"),
        ):
            audit(outcome(ending))
        audit.report_suppressed()
        audit.report_suppressed()
    assert len(published) == len(recorded) == BURST + 3 + 1
    assert rings == BURST * [True] + 3 * [False] + [True]
    assert [text.encode() for _, text in recorded] == published
    assert [time for time, _ in recorded[:-1]] == [*range(BURST), 0, 0, 0]
    words = [json.loads(data)["outcome"] for data in published[BURST:]]
    assert words == ["written", "unclear", "refused", "suppressed"]
    summary = json.loads(published[-1])
    assert (summary["count"], summary["kinds"]) == (9_700, {"unknown-tag": 9_700})
    assert audit.suppressed == 10_000 - BURST
    assert len(lines) == BURST + 3 + 1
    assert lines[-1]["count"] == 10_000 - BURST


def test_every_entry_of_an_outcome_is_known_as_audited() -> None:
    """The log writes all of these, however often they come."""
    audit = Audit(lambda _: None)
    ends: list[WriteResult | CommandResult | Failure]
    ends = [WriteResult(1, 0, took=0.1), CommandResult("ok", 0, 0.1)]
    with structlog.testing.capture_logs() as lines:
        for result in [*ends, *(Failure(problem, "why") for problem in Problem)]:
            for command in (False, True):
                audit(replace(outcome(result), command=command))
    assert {line["event"] for line in lines} == audited.EVENTS - {*audited.OF_ALARMS}


def test_a_rate_limit_allows_a_burst_and_then_one_per_interval() -> None:
    limit = RateLimit(burst=3, every=2.0)
    passed = [now for now in range(20) if limit.allows(float(now) / 2)]
    assert passed == [0, 1, 2, 4, 8, 12, 16]
    assert limit.newly_suppressed() == limit.suppressed == 20 - len(passed)
    assert limit.newly_suppressed() == 0


def test_a_transfer_that_writes_each_second_fills_no_log_and_no_history() -> None:
    published: list[bytes] = []
    recorded: list[bool] = []
    audit = Audit(published.append, lambda time, text, *, refused: recorded.append(refused))
    done, busy = WriteResult(1, 0, took=0.1), Failure(Problem.BUSY, "offline")
    unclear = Failure(Problem.UNCLEAR, "?")
    with structlog.testing.capture_logs() as lines:
        ends: list[WriteResult | Failure] = [*[done] * 500, *[busy] * 500, unclear, unclear, done]
        for end in ends:
            audit.of_transfer(outcome(end))
        audit(outcome(busy))  # a client's refusal still has all the room
    assert [line["event"] for line in lines] == [
        *("tag written", "write failed", "write unclear", "tag written", "write failed"),
    ]
    assert recorded == [False, True, False, False, True]
    assert len(published) == 500 + 1 + 2 + 1 + 1  # what was sent is published, each time
    assert audit.suppressed == 0
