"""The log writer: in order, bounded, and it says how many entries were dropped."""

import logging
import os
from collections.abc import Iterator

import pytest
import structlog

from gateway.cli import logs
from gateway.cli.logs import QueuedHandler, Repeats


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    os.close(reader)
    os.close(writer)


def test_entries_are_written_in_order_until_the_end(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    handler = QueuedHandler(writer)
    for number in range(100):
        handler.emit(logging.makeLogRecord({"msg": f"entry {number}"}))
    handler.write("one\ntwo \ud800")
    handler.close()
    lines = os.read(reader, 65536).decode().splitlines()
    assert lines == [*(f"entry {number}" for number in range(100)), "one", "two \\ud800"]


def test_entries_beyond_the_limit_are_dropped_and_reported(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = pipe
    monkeypatch.setattr(logs, "LIMIT", 4)
    handler = QueuedHandler(writer)
    handler.write("x" * 1_000_000)  # more than a pipe holds: the thread waits for the reader
    for _ in range(1000):
        handler.write("y")
    assert handler.dropped >= 990
    with structlog.testing.capture_logs() as reported:
        received = b""
        while received.count(b"y") < 1000 - handler.dropped:
            received += os.read(reader, 65536)
        handler.close()
    assert [(entry["event"], entry["count"]) for entry in reported] == [
        ("log entries dropped", handler.dropped)
    ]


def test_a_reader_that_has_gone_costs_only_the_entries(pipe: tuple[int, int]) -> None:
    missing = os.dup(pipe[1])
    os.close(missing)  # as a full disk: every write fails
    handler = QueuedHandler(missing)
    for _ in range(5):
        handler.write("y")
    handler.close()
    assert handler.dropped == 5


def test_repeated_entries_of_a_device_are_logged_now_and_then_with_their_number() -> None:
    now = 0.0
    repeats = Repeats(lambda: now)

    def passes(**entry: object) -> dict[str, object] | None:
        try:
            return dict(repeats(None, "info", entry))
        except structlog.DropEvent:
            return None

    failed = {"event": "transaction failed", "device": "mixer", "line": "hall"}
    found = [passes(**failed) for _ in range(100)]
    assert [one for one in found if one is not None] == [failed] * logs.BURST
    assert passes(**failed | {"device": "oven"})
    assert passes(**failed | {"event": "device offline"})
    now = logs.EVERY
    assert passes(**failed) == failed | {"unlogged": 100 - logs.BURST}
    assert passes(**failed) is None
    assert all(passes(event="tag written", key="plant/mixer/speed") for _ in range(100))
