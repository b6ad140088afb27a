"""Listening: which reply belongs to which request, and the frames of both directions."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from gateway.protocols.checksums import crc16
from gateway.protocols.computer_link import ComputerLink
from gateway.protocols.computer_link.codec import Ack, Enquiry, Frame, LinkCodec, Text
from gateway.protocols.driver import Span
from gateway.protocols.listening import (
    Asked,
    Heard,
    Listenable,
    Noise,
    Pairing,
    Told,
    TrafficReader,
)
from gateway.protocols.modbus import ModbusAscii, ModbusRtu
from gateway.protocols.modbus.traffic import RtuTrafficReader
from gateway.protocols.vigor import Vigor
from tests.doubles import octets
from tests.vectors import vectors

CHARACTER = 0.001
TIMEOUT, GUARD = 0.5, 1.0
A = Asked(1, b"a", 10, shape=4, error="no", read="a")
B = Asked(1, b"b", 10, shape=4, error="no", read="b")
LONGER = Asked(1, b"c", 12, shape=6, error="no", read="c")
REPLY, LONG_REPLY, ERROR = Told(1, 4, b"."), Told(1, 6, b"..."), Told(1, "no", is_error=True)
NOISE = Noise(b"?")

Step = tuple[float, Heard]


def paired(*steps: Step) -> list[bytes | None]:
    """Returns the request of each reply: its content, or None in doubt."""
    pairing, found = Pairing(GUARD, CHARACTER), list[bytes | None]()
    for now, heard in steps:
        match heard:
            case Asked():
                pairing.asked(heard, now)
            case Noise():
                pairing.noise(now)
            case Told():
                asked = pairing.told(heard, now, TIMEOUT)
                found.append(None if asked is None else asked.content)
    return found


def rtu(*body: int) -> bytes:
    return bytes(body) + crc16(bytes(body))


# Pairs


@pytest.mark.parametrize(
    ("steps", "found"),
    [
        ([(0.0, A), (0.1, REPLY), (0.2, B), (0.3, REPLY)], [b"a", b"b"]),
        ([(0.0, REPLY)], [None]),  # its request was not heard
        ([(0.0, A), (0.1, Told(2, 4))], [None]),  # of another station
        ([(0.0, A), (0.1, LONG_REPLY)], [None]),  # of another length
        ([(0.0, A), (0.1, NOISE), (0.2, REPLY)], [None]),  # something lay between
        ([(0.0, A), (0.6, REPLY)], [None]),  # too late
        ([(0.0, A), (0.1, Asked(2, b"x", 10, shape=4)), (0.2, REPLY)], [None]),
    ],
)
def test_a_reply_belongs_to_the_request_just_before_it(
    steps: Sequence[Step], found: list[bytes | None]
) -> None:
    assert paired(*steps) == found


def test_a_late_reply_to_an_older_request_is_not_taken_for_the_reply_to_the_next() -> None:
    assert paired((0.0, A), (0.6, B), (0.61, REPLY)) == [None]
    assert paired((0.0, A), (0.6, B), (0.61, ERROR)) == [None]


def test_the_doubt_goes_on_while_each_reply_may_be_that_of_the_request_before() -> None:
    replies: list[Step] = [
        (0.6, B),
        (0.65, REPLY),
        (0.7, A),
        (0.75, REPLY),
        (0.8, B),
        (0.85, REPLY),
    ]
    assert paired((0.0, A), *replies) == [None, None, None]


def test_a_reply_that_fits_no_older_request_ends_the_doubt() -> None:
    steps: list[Step] = [(0.0, A), (0.6, LONGER), (0.65, LONG_REPLY), (0.7, B), (0.75, REPLY)]
    assert paired(*steps) == [b"c", b"b"]


def test_the_doubt_ends_when_no_late_reply_can_arrive_any_more() -> None:
    assert paired((0.0, A), (1.1, B), (1.2, REPLY)) == [b"b"]


def test_an_equal_request_is_answered_by_either_reply() -> None:
    assert paired((0.0, A), (0.6, A), (0.65, REPLY), (0.7, B), (0.75, REPLY)) == [b"a", None]


def test_a_reply_that_may_be_the_first_of_equal_requests_ends_no_doubt_about_later_ones() -> None:
    """Found by misleading traffic: A B A, and the reply to the first A."""
    steps: list[Step] = [(0.0, LONGER), (0.1, A), (0.2, LONGER), (0.3, LONG_REPLY), (0.4, B)]
    assert paired(*steps, (0.41, REPLY)) == [b"c", None]


def test_after_noise_no_reply_is_certain_for_a_while() -> None:
    """It may have hidden a request."""
    steps: list[Step] = [(0.0, NOISE), (0.5, A), (0.6, REPLY), (1.1, LONGER), (1.2, LONG_REPLY)]
    assert paired(*steps) == [None, b"c"]


def test_a_second_reply_makes_the_first_one_doubtful() -> None:
    pairing = Pairing(GUARD, CHARACTER)
    pairing.asked(A, 0.0)
    assert pairing.told(REPLY, 0.1, TIMEOUT) is A
    assert not pairing.was_extra()
    assert pairing.told(REPLY, 0.2, TIMEOUT) is None
    assert pairing.was_extra()
    pairing.asked(B, 0.3)
    assert pairing.told(REPLY, 0.4, TIMEOUT) is None


def test_a_broadcast_waits_for_no_reply() -> None:
    everyone = Asked(0, b"b", 8, answered=False)
    assert paired((0.0, everyone), (0.1, A), (0.2, REPLY)) == [b"a"]
    assert paired((0.0, A), (0.1, everyone), (0.2, REPLY)) == [None]


# Frames


def chopped(new: Callable[[], TrafficReader], frames: Sequence[bytes]) -> list[list[Heard]]:
    """Returns what the frames mean, in pieces of one byte, of three, and all at once."""
    whole = b"".join(frames)
    found = []
    for size in (1, 3, len(whole)):
        reader, heard = new(), list[Heard]()
        for at in range(0, len(whole), size):
            heard += reader.feed(whole[at : at + size], 1.0 if at == 0 else 0.0)
        found.append(heard)
    return found


def learned(driver: Listenable, asked: Asked, told: Told, span: Span) -> list[int] | None:
    learn = driver.learn(asked.read, span)
    units = None if learn is None else learn(told.data)
    return None if units is None else list(units)


def test_modbus_rtu_in_any_pieces() -> None:
    frames = [
        octets("03 03 80 64 00 01 ed f7"),  # of a recording
        octets("03 03 02 00 1a 40 4f"),
        rtu(3, 16, 0, 1, 0, 1, 2, 0, 7),
        rtu(3, 16, 0, 1, 0, 1),
        rtu(3, 0x2B, 0),  # an unknown function
    ]
    for heard in chopped(lambda: RtuTrafficReader(CHARACTER), frames):
        asked, told, written, done, *rest = heard
        assert isinstance(asked, Asked)
        assert isinstance(told, Told)
        assert learned(ModbusRtu(station=3), asked, told, Span("holding", 32868, 1)) == [26]
        assert learned(ModbusRtu(station=3), asked, told, Span("holding", 32868, 2)) is None
        assert learned(ModbusRtu(station=3), asked, told, Span("input", 32868, 1)) is None
        assert isinstance(written, Asked)
        assert isinstance(done, Told)
        assert written.read is None
        assert rest
        assert all(isinstance(one, Noise) for one in rest)


def test_a_frame_of_modbus_rtu_begins_after_a_silence_or_a_whole_frame() -> None:
    request = rtu(1, 3, 0, 0, 0, 1)
    reader = RtuTrafficReader(CHARACTER)
    assert all(isinstance(one, Noise) for one in reader.feed(request[3:] + request, 1.0))
    assert all(isinstance(one, Noise) for one in reader.feed(request, 0.001))  # no silence yet
    assert isinstance(reader.feed(request, 0.0036)[-1], Asked)
    assert isinstance(reader.feed(rtu(1, 3, 2, 0, 5), 0.0)[-1], Told)
    damaged = bytes((*request[:-1], request[-1] ^ 1))
    [noise, again] = reader.feed(damaged, 0.01) + reader.feed(request, 0.25)
    assert isinstance(noise, Noise)
    assert isinstance(again, Asked)


def test_a_reply_with_24_bits_that_may_be_a_request_is_not_believed() -> None:
    reader = RtuTrafficReader(CHARACTER)
    reader.feed(rtu(1, 1, 0, 16, 0, 20), 1.0)
    [heard] = reader.feed(rtu(1, 1, 3, 0xAA, 0, 16), 0.01)  # or: read 16 coils from 03AAh
    assert isinstance(heard, Noise)
    reader.feed(rtu(1, 1, 0, 16, 0, 20), 0.01)
    [heard] = reader.feed(rtu(1, 1, 3, 0xAA, 0xFF, 0xF0), 0.01)  # no request has so many
    assert isinstance(heard, Told)


def test_modbus_ascii_in_any_pieces() -> None:
    frames = [b":010300000001FB\r\n", b":0103020005F5\r\n", b"xx", b":010300000001FC\r\n"]
    for heard in chopped(lambda: ModbusAscii(station=1).traffic_reader(CHARACTER), frames):
        asked, told, *rest = heard
        assert isinstance(asked, Asked)
        assert isinstance(told, Told)
        assert learned(ModbusAscii(station=1), asked, told, Span("holding", 0, 1)) == [5]
        assert rest
        assert all(isinstance(one, Noise) for one in rest)


def test_vigor_in_any_pieces() -> None:
    """The reads of the manual, B-5-3."""
    known = {vector.id: vector.frame for vector in vectors("vigor")}
    request = octets("02 30 30 35 31 31 43 30 32 30 34 03 30 33")
    reply = octets("06 30 30 35 31 30 30 33 34 31 32 43 44 41 42 03 46 44")
    assert request in known.values()
    assert reply in known.values()
    driver = Vigor(station=0)
    for heard in chopped(
        lambda: driver.traffic_reader(CHARACTER), [b"\x00", request, reply, reply[:-1] + b"x"]
    ):
        noise, asked, told, damaged = heard[0], heard[1], heard[2], heard[3:]
        assert isinstance(noise, Noise)
        assert isinstance(asked, Asked)
        assert isinstance(told, Told)
        assert learned(driver, asked, told, Span("D", 1, 2)) == [0x1234, 0xABCD]
        assert learned(driver, asked, told, Span("D", 2, 1)) == [0xABCD]
        assert learned(driver, asked, told, Span("D", 0, 1)) is None
        assert learned(driver, asked, told, Span("D", 2, 2)) is None
        assert damaged
        assert all(isinstance(one, Noise) for one in damaged)


@pytest.mark.parametrize("frame_format", [1, 4])
@pytest.mark.parametrize("sum_check", [True, False])
def test_computer_link_in_any_pieces(frame_format: int, sum_check: bool) -> None:
    driver = ComputerLink(station=5, frame_format=frame_format, sum_check=sum_check)  # type: ignore[arg-type]
    codec = LinkCodec(driver.frame_format, sum_check)
    frames: list[Frame] = [
        Enquiry(5, "WR", "D010002"),
        Text(5, "0041ABCD"),
        Ack(5),  # area C: the master confirms the data
        Enquiry(5, "BR", "M001603"),
        Text(5, "101"),
        Enquiry(5, "WW", "D0100010001"),
        Ack(5),
    ]
    for heard in chopped(
        lambda: driver.traffic_reader(CHARACTER), [codec.encode(one) for one in frames]
    ):
        kinds = [type(one) for one in heard]
        assert kinds == [Asked, Told, Asked, Told, Asked, Told]
        words, data, bits, states, write, _ = heard
        assert isinstance(words, Asked)
        assert isinstance(data, Told)
        assert learned(driver, words, data, Span("D", 101, 1)) == [0xABCD]
        assert learned(driver, words, data, Span("D", 101, 2)) is None
        assert isinstance(bits, Asked)
        assert isinstance(states, Told)
        assert learned(driver, bits, states, Span("M", 17, 2)) == [0, 1]
        assert learned(driver, bits, states, Span("X", 17, 1)) is None
        assert isinstance(write, Asked)
        assert write.read is None


def test_words_over_bits_of_the_computer_link() -> None:
    driver = ComputerLink(station=0)
    learn = driver.learn(_read("WR", "M001602"), Span("M", 33, 3))
    assert learn is not None
    assert learn("0000001A") == [1, 0, 1]


def _read(command: str, area: str) -> Any:
    reader = ComputerLink(station=0).traffic_reader(CHARACTER)
    [asked] = reader.feed(LinkCodec().encode(Enquiry(0, command, area)), 1.0)
    assert isinstance(asked, Asked)
    return asked.read
