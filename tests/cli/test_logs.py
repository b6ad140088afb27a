"""The log writer: in order, bounded, and it says how many entries were dropped."""

import logging
import os
from collections.abc import Iterator

import pytest
import structlog

from gateway.cli import logs
from gateway.cli.logs import QueuedHandler


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
