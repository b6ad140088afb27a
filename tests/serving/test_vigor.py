"""Vigor stations of the gateway: the examples of the manual, and a master that uses Easy Link."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.serving.bench import Bench
from tests.serving.easy_link import EXAMPLE, EasyLink, frame

BITS = {f"m{n}": {"address": f"M{n}"} for n in (*range(100, 130), 10)}
WORDS = {f"d{n}": {"address": f"D{n}", "write": True} for n in range(10, 20)}
STATIONS: dict[str, Any] = {
    "five": {
        "protocol": "vigor",
        "station": 5,
        "tags": {**WORDS, "count": {"address": "C200", "source": "mixer/speed"}},
    },
    "two": {
        "protocol": "vigor",
        "station": 2,
        "accept": ["M100..M129", "M10", "D0..D3", "C200", "Y30..Y47"],
        "tags": {
            **BITS,
            "order": {"address": "D0", "type": "int32"},
            "counter": {"address": "C200"},
            "lamp": {"address": "Y37"},
        },
    },
}


def bench() -> Bench:
    made = Bench("/dev/ttyS98", STATIONS)
    made.values |= {f"five/d{n}": 100 * n for n in range(10, 20)}
    made.values["mixer/speed"] = 0x12345
    return made


def ask(made: Bench, station: int, command: str, body: str) -> str:
    """Returns status and data of the reply; empty for silence."""
    reply = made.ask(frame(station, command, body)).decode()
    assert not reply or reply[:5] == f"\x06{station:02X}{command}"
    return reply[5:-3]


def test_easy_link_performs_the_table_of_the_manual() -> None:
    made = bench()
    master = EasyLink(made.ask)
    bits = [n % 3 == 0 for n in range(30)]
    master.devices = {(3, n): int(bit) for n, bit in enumerate(bits)}
    assert master.perform(EXAMPLE) == ["00", "00"]
    assert [master.devices[13, n] for n in range(10)] == [100 * n for n in range(10, 20)]
    assert made.written == [{f"m{100 + n}": bit for n, bit in enumerate(bits)}]
    assert len({sample.time for sample in made.samples_given[0]}) == 1


def test_b5_3_force_and_write_as_in_the_manual() -> None:
    made = bench()
    assert made.ask(b"\x020270040A\x03A1") == b"\x0602" + b"7000\x032C"  # M10 ON
    assert made.written == [{"m10": True}]
    # Y30..Y47, 16 bits in two bytes
    assert ask(made, 2, "61", "0043021C80") == "00"
    assert made.written[1:] == [{"lamp": False}]
    assert ask(made, 2, "51", "004302") == "001C80"


@pytest.mark.parametrize(
    ("station", "command", "body", "status"),
    [
        (5, "51", "1C0002", "28"),  # D0: no tag
        (5, "51", "1C1416", "28"),  # D10..D20
        (5, "61", "1C14020100", "28"),  # not accepted
        (2, "61", "1C00020100", "28"),  # one half of 32 bits
        (2, "61", "1C000100", "28"),  # one half of a word
        (2, "61", "1A00021234", "28"),  # one half of a counter
        (2, "61", "008C01FF", "28"),  # M96..M103: M96 is not accepted
        (2, "70", "0463", "28"),  # M99
        (2, "71", "0E10", "28"),  # D
        (2, "51", "1C0000", "28"),
        (2, "51", "1C0081", "28"),
        (2, "51", "037D01", "28"),  # a hole of the map
        (2, "51", "1C0004", "28"),  # not written yet
        (2, "51", "1C00", "10"),
        (2, "61", "1C000401", "10"),
        (2, "51", "1c0004", "10"),
        (2, "99", "", "12"),
    ],
)
def test_everything_else_gets_the_status_of_the_manual(
    station: int, command: str, body: str, status: str
) -> None:
    made = bench()
    assert ask(made, station, command, body) == status
    assert made.written == []


def test_words_and_counters_are_written_as_a_whole() -> None:
    made = bench()
    assert ask(made, 2, "61", "1C0004FEFFFFFF") == "00"
    assert ask(made, 2, "61", "1A000478563412") == "00"
    assert made.written == [{"order": -2}, {"counter": 0x12345678}]
    assert ask(made, 2, "51", "1A0004") == "0078563412"
    assert ask(made, 5, "51", "1A0004") == "0045230100"


def test_a_wrong_sum_gets_status_11_and_other_stations_get_silence() -> None:
    made, write = bench(), frame(2, "61", "1C0004FEFFFFFF")
    assert made.ask(write[:-2] + b"00") == b"\x0602" + b"6111\x032E"
    assert ask(made, 3, "51", "1C0002") == ""
    assert made.ask(b"\x0603" + b"5100" + b"0100\x03EE") == b""
    assert made.written == []


def test_half_a_request_and_the_reply_of_another_station_are_no_request() -> None:
    made, write = bench(), frame(2, "61", "1C0004FEFFFFFF")
    assert made.ask(write[:12]) == b""
    assert made.ask(b"\x0603" + b"5100" + b"0100\x03EE", after=0.05) == b""
    assert made.ask(write[:12]) == b""
    assert made.ask(write[12:], after=0.2) == b""
    assert made.ask(write[:12]) == b""
    assert made.ask(write[12:], after=0.05) != b""
    assert len(made.written) == 1


def test_a_request_that_another_follows_is_neither_done_nor_answered() -> None:
    made, write = bench(), frame(2, "61", "1C0004FEFFFFFF")
    assert made.ask(write + frame(3, "51", "1C0002")) == b""
    assert made.ask(write + write[:4]) == b""
    assert made.written == []
    assert made.line.stale == 2


@settings(max_examples=40)
@given(st.lists(st.one_of(st.binary(max_size=16), st.sampled_from([b"\x0202", b"\x03", b"61"]))))
def test_any_bytes_write_nothing(pieces: list[bytes]) -> None:
    made = bench()
    for piece in pieces:
        made.hear(piece, after=0.01)
    assert made.written == []
    made.now += 1
    assert ask(made, 5, "51", "1C1402") == "00E803"


@settings(max_examples=40)
@given(st.integers(0, 14), st.integers(1, 255))
def test_a_damaged_write_is_never_done(place: int, flip: int) -> None:
    made, damaged = bench(), bytearray(frame(2, "61", "1C0004FEFFFFFF"))
    damaged[place] ^= flip
    reply = made.ask(bytes(damaged))
    assert reply[5:7] != b"00"
    assert made.written == []
