"""The wire log: its listeners, and no cost while it is off."""

from gateway.line.exchanges import shown
from gateway.line.wire_log import Event, Piece, WireLog
from gateway.tags import good
from tests.history_writer import tag


def test_without_a_listener_the_wire_log_is_off() -> None:
    assert not WireLog().active


def test_a_listener_turns_it_on_and_gets_every_byte_with_its_direction() -> None:
    wire_log, passed = WireLog(), list[Event]()
    wire_log.listen(passed.append)
    assert wire_log.active
    wire_log.sent(b"\x02\x30")
    wire_log.heard(b"\x06")
    assert passed == [Piece(">", b"\x02\x30"), Piece("<", b"\x06")]


def test_every_listener_gets_the_bytes_until_it_is_forgotten() -> None:
    wire_log = WireLog()
    first, second = list[Event](), list[Event]()
    take = first.append
    wire_log.listen(take)
    wire_log.sent(b"1")
    wire_log.listen(second.append)
    wire_log.forget(take)
    assert wire_log.active
    wire_log.sent(b"2")
    wire_log.forget(second.append)
    assert not wire_log.active
    assert (first, second) == ([Piece(">", b"1")], [Piece(">", b"2")])


def test_an_exchange_shows_the_first_elements_of_an_array() -> None:
    long, short = good(tag("steps"), (1, 2, 3, 4, 5, 6), 0), good(tag("run"), (True, False), 0)
    assert shown([long, short]) == "steps [1, 2, 3, 4 and 2 more], run [True, False]"
