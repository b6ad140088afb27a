"""The log writer: in order, bounded, and it says how many entries were dropped."""

import logging
import os
from collections.abc import Iterator

import pytest
import structlog

from gateway.cli.line import logs, repeats
from gateway.cli.line.logs import QueuedHandler
from gateway.cli.line.repeats import Repeats
from gateway.contract import audited


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


class Log:
    """The entries that pass `Repeats`, by hand."""

    def __init__(self) -> None:
        self.now = 0.0
        self.repeats = Repeats(lambda: self.now)

    def passes(self, event: str, **fields: object) -> bool:
        try:
            self.repeats(None, "info", {"event": event, **fields})
        except structlog.DropEvent:
            return False
        return True

    def later(self, seconds: float) -> list[tuple[str, object]]:
        """Flushes after so many seconds: each entry, and the number of others that it stands for.

        What is logged here passes the configuration of the tests, not that of `set_up`.
        """
        self.now += seconds
        with structlog.testing.capture_logs() as logged:
            self.repeats.flush()
        assert all(entry.pop("repeated") and entry["last"] for entry in logged)
        return [(entry["event"], entry.get("unlogged", 0)) for entry in logged]


def test_an_audited_entry_never_waits_whatever_waits_beside_it() -> None:
    log = Log()
    for number in range(100):
        log.passes("alarm raised", alarm=f"mixer/{number}")
    for event in audited.EVENTS:
        assert all(log.passes(event, key="mixer/recipe", by="Ana") for _ in range(100)), event
    assert all(log.passes("alarm acknowledged", alarm="a", by=f"by {n}") for n in range(60))


def test_what_repeats_is_logged_at_once_and_then_once_a_minute_with_its_number() -> None:
    log, mixer = Log(), {"device": "mixer", "line": "hall"}
    found = [log.passes("transaction failed", why="no reply", **mixer) for _ in range(100)]
    assert found == [True] + [False] * 99
    assert log.passes("transaction failed", why="no reply", device="oven", line="hall")
    assert log.passes("device offline", why="no reply", **mixer)
    assert log.later(59.0) == []
    assert log.later(1.0) == [("transaction failed", 98)]
    assert not log.passes("transaction failed", why="no reply", **mixer)
    assert log.later(60.0) == [("transaction failed", 0)]
    assert log.later(60.0) == []
    assert log.passes("transaction failed", why="no reply", **mixer)


def test_different_reasons_are_told_apart_up_to_a_number() -> None:
    log = Log()
    found = [log.passes("reply dropped", device="mixer", why=str(n)) for n in range(1000)]
    assert found.count(True) == repeats.BURST
    assert len(log.later(60.0)) <= repeats.BURST
    assert log.passes("reply dropped", device="mixer", why="a new one")


def test_the_last_entry_of_a_state_that_flaps_is_the_state() -> None:
    log = Log()
    for _ in range(repeats.BURST):  # a cable that is plugged and unplugged is logged at once
        assert log.passes("device offline", device="mixer")
        assert log.passes("device online", device="mixer")
    assert not log.passes("device offline", device="mixer")
    for _ in range(7):
        assert not log.passes("device online", device="mixer")
        assert not log.passes("device offline", device="mixer")
    assert log.later(60.0) == [("device online", 6), ("device offline", 7)]


def test_each_write_is_logged_and_other_libraries_are_limited_each() -> None:
    log = Log()
    assert all(log.passes("tag written", key="plant/mixer/speed") for _ in range(100))
    found = [log.passes("socket.send() raised exception.", logger="asyncio") for _ in range(9)]
    assert found == [True] + [False] * 8
    assert log.passes("port is slow", logger="serialx")


def test_links_of_one_host_are_one_source() -> None:
    log = Log()
    found = [
        log.passes("Zenoh link up", to="peer", address=f"tcp/10.0.0.5:{n}", id=str(n))
        for n in range(100)
    ]
    assert found.count(True) == repeats.BURST
    assert log.passes("Zenoh link up", to="peer", address="tcp/10.0.0.6:1", id="x")
