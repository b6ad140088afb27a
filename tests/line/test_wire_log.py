"""The wire log: its listeners, its lines in the log, and no cost while it is off."""

import logging

import pytest

from gateway.line.wire_log import WireLog


@pytest.fixture(autouse=True)
def quiet_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gateway.wire")


def test_without_a_listener_the_wire_log_is_off() -> None:
    assert not WireLog("hall").active


def test_a_listener_turns_it_on_and_gets_every_byte_with_its_direction() -> None:
    wire_log = WireLog("hall")
    passed: list[tuple[str, bytes]] = []
    wire_log.listen(lambda direction, data: passed.append((direction, data)))
    assert wire_log.active
    wire_log.sent(b"\x02\x30")
    wire_log.heard(b"\x06")
    assert passed == [(">", b"\x02\x30"), ("<", b"\x06")]


def test_every_listener_gets_the_bytes_from_then_on() -> None:
    wire_log = WireLog("hall")
    first, second = list[bytes](), list[bytes]()
    wire_log.listen(lambda _, data: first.append(data))
    wire_log.sent(b"1")
    wire_log.listen(lambda _, data: second.append(data))
    wire_log.sent(b"2")
    assert (first, second) == ([b"1", b"2"], [b"2"])


def test_the_debug_log_turns_it_on(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, "gateway.wire")
    wire_log = WireLog("hall")
    assert wire_log.active
    wire_log.sent(b"\x02\x30")
    wire_log.heard(b"\x06")
    assert [record.getMessage() for record in caplog.records] == ["hall > 02 30", "hall < 06"]
