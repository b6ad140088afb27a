"""Modbus TCP stations of the gateway, without a connection."""

import asyncio
from typing import cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.parts.serving.conversation import Conversation
from gateway.tags import Quality, Reason
from gateway.transport import Port
from tests.serving.bench import Bench

TAGS = {
    "speed": {"address": "holding:0", "source": "mixer/speed"},
    "level": {"address": "holding:1", "type": "float32", "source": "mixer/level"},
    "kept": {"address": "holding:5", "source": "mixer/speed", "hold_last": True},
    "run": {"address": "coil:0", "source": "mixer/run"},
    "bit": {"address": "holding:6.3", "source": "mixer/run"},
    "high": {"address": "holding:6", "type": "uint8", "byte": "high", "source": "mixer/gear"},
    "limit": {"address": "input:7", "write": True},
    "setpoint": {"address": "holding:100", "type": "int16"},
    "ramp": {"address": "holding:102", "type": "float32", "word_order": "high_first"},
    "door": {"address": "holding:104.2"},
    "start": {"address": "coil:10"},
}
HMI = {
    "protocol": "modbus-tcp",
    "station": 1,
    "accept": ["holding:100..holding:119", "coil:10..coil:12"],
    "stale_after": "5s",
    "tags": TAGS,
}


def bench() -> Bench:
    made = Bench("tcp://127.0.0.1:5020", {"hmi": HMI})
    made.values = {"mixer/speed": 1234, "mixer/level": 1.5, "mixer/run": True, "mixer/gear": 5}
    made.values["hmi/limit"] = 9
    return made


def ask(made: Bench, pdu: str, unit: int = 1) -> str:
    """Returns the PDU of the reply."""
    data = bytes.fromhex(pdu)
    head = bytes.fromhex("1234 0000") + (len(data) + 1).to_bytes(2, "big") + bytes((unit,))
    reply = made.ask(head + data)
    assert reply[:4] == bytes.fromhex("1234 0000")
    assert reply[4:7] == (len(reply) - 6).to_bytes(2, "big") + bytes((unit,))
    return reply[7:].hex(" ")


def test_a_master_reads_the_values_of_other_tags_in_their_own_types() -> None:
    made = bench()
    assert ask(made, "03 0000 0003") == "03 06 04 d2 00 00 3f c0"  # 1.5, low word first
    assert ask(made, "01 0000 0001") == "01 01 01"
    assert ask(made, "03 0006 0001") == "03 02 05 08"
    assert ask(made, "04 0007 0001") == "04 02 00 09"


def test_a_bad_value_is_refused_or_answered_with_the_last_good_one() -> None:
    made = bench()
    assert ask(made, "03 0005 0001") == "03 02 04 d2"
    made.values["mixer/speed"] = None
    assert ask(made, "03 0000 0001") == "83 04"
    assert ask(made, "03 0005 0001") == "03 02 04 d2"
    made.values["mixer/speed"] = 70000  # does not fit the register
    assert ask(made, "03 0000 0001") == "83 04"


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("03 0003 0002", "83 02"),  # no tag
        ("03 0000 0004", "83 02"),  # the last has no tag
        ("03 0000 0000", "83 03"),
        ("03 0000 007e", "83 03"),
        ("03 0000", "83 03"),
        ("03", "83 03"),
        ("06 0000 0001", "86 02"),  # outside `accept`
        ("06 0063 0001", "86 02"),
        ("10 0063 0002 04 0001 0001", "90 02"),  # partly outside
        ("10 0077 0002 04 0001 0001", "90 02"),
        ("06 0066 0001", "86 02"),  # half of a float
        ("10 0067 0002 04 0001 0001", "90 02"),
        ("05 000a 0001", "85 03"),
        ("05 0009 ff00", "85 02"),
        ("10 0064 0002 03 0001 0001", "90 03"),
        ("2b 0e 01 00", "ab 01"),
        ("08 0000 1234", "88 01"),
        ("00", "80 01"),
    ],
)
def test_everything_else_gets_the_error_of_the_protocol(request_: str, reply: str) -> None:
    made = bench()
    assert ask(made, request_) == reply
    assert made.written == []


def test_a_write_over_several_registers_is_one_event_with_one_time() -> None:
    made = bench()
    assert ask(made, "10 0064 0005 0a fffe 0000 3fc0 0000 0004") == "10 00 64 00 05"
    assert made.written == [{"setpoint": -2, "ramp": 1.5, "door": True}]
    assert len({sample.time for sample in made.samples_given[0]}) == 1
    assert ask(made, "03 0064 0014")[:21] == "03 28 ff fe 00 00 3f "
    assert ask(made, "0f 000a 0003 01 05") == "0f 00 0a 00 03"
    assert made.written[1:] == [{"start": True}]
    assert ask(made, "01 000a 0003") == "01 01 05"


def test_an_equal_write_is_an_event_of_its_own() -> None:
    made = bench()
    for _ in range(2):
        assert ask(made, "06 0064 0007") == "06 00 64 00 07"
    assert made.written == [{"setpoint": 7}, {"setpoint": 7}]
    [sample] = made.samples_given[0]
    assert sample.tag.publishing.event
    assert sample.quality is Quality.GOOD


def test_words_that_are_no_value_are_taken_and_bad() -> None:
    made = bench()
    assert ask(made, "10 0066 0002 04 7fc0 0000") == "10 00 66 00 02"
    assert made.samples_given[0][0].reason is Reason.NOT_A_NUMBER


def test_what_no_master_has_written_yet_is_refused() -> None:
    made = bench()
    assert ask(made, "03 0064 0001") == "83 04"
    assert ask(made, "03 0070 0001") == "03 02 00 00"  # without a tag it is memory


def test_what_a_silent_master_wrote_turns_bad_until_it_writes_again() -> None:
    made = bench()
    [station] = made.line.stations.values()
    station.opened(made.now)
    ask(made, "06 0064 0007")
    assert made.online_given == [("hmi", True)]
    assert station.due == made.now + 5
    assert station.expire(made.now + 4.9, 1) == ()
    stale = station.expire(made.now + 5, 1)
    assert {sample.tag.name for sample in stale} == {"setpoint", "ramp", "door", "start"}
    assert {sample.reason for sample in stale} == {Reason.NO_REPLY}
    assert station.diagnosed().text == "The master has sent no request to station 1 for 5 s"
    assert ask(made, "03 0064 0001") == "83 04"  # the master may have started again
    assert made.online_given == [("hmi", True), ("hmi", True)]
    ask(made, "06 0064 0008")
    assert ask(made, "03 0064 0001") == "03 02 00 08"
    assert (station.counts.requests, station.counts.writes) == (4, 2)


def test_a_lost_port_turns_what_the_master_wrote_bad() -> None:
    made = bench()
    [station] = made.line.stations.values()
    ask(made, "06 0064 0007")
    assert {one.reason for one in station.lost(1, "closed")} == {Reason.LINE_DOWN}
    assert station.diagnosed().text == "The line is down: closed"
    station.opened(made.now)
    assert ask(made, "03 0064 0001") == "83 04"
    assert station.diagnosed().text == ""


def test_units_of_other_stations_have_no_path_and_a_single_station_has_two_more() -> None:
    made = bench()
    assert ask(made, "03 0000 0001", unit=2) == "83 0a"
    assert ask(made, "03 0000 0001", unit=255) == "03 02 04 d2"
    assert ask(made, "03 0000 0001", unit=0) == "03 02 04 d2"


def test_requests_in_one_piece_and_in_many_are_all_answered() -> None:
    made = bench()
    one = bytes.fromhex("0001 0000 0006 01 06 0064 0001")
    two = bytes.fromhex("0002 0000 0006 01 03 0064 0001")
    assert made.ask(one + two).hex() == "000100000006010600640001" + "0002000000050103020001"
    replies = b"".join(made.ask(bytes((byte,))) for byte in one + two)
    assert len(replies) == 23


class Closed(list[bytes]):
    """A port that keeps what is written."""

    write = list.append

    async def close(self) -> None:
        self.append(b"closed")


async def test_what_arrives_after_the_end_of_a_connection_is_neither_done_nor_answered() -> None:
    made, port = bench(), Closed()
    talk = Conversation(made.line, network=True)
    talk.opened(cast(Port, port))
    for data in (b"GET / HTTP/1.1\r\n\r\n", bytes.fromhex("0001 0000 0006 01 06 0064 0007")):
        talk.received(data)
    await asyncio.sleep(0)
    assert (port, made.written) == ([b"closed"], [])


def test_bytes_that_are_no_modbus_end_the_connection() -> None:
    made = bench()
    heard = made.hear(b"GET / HTTP/1.1\r\n\r\n")
    assert heard.lost
    assert heard.reply == b""


@settings(max_examples=40)
@given(st.lists(st.binary(max_size=40), max_size=8), st.binary(max_size=12))
def test_any_bytes_write_nothing_outside_accept(pieces: list[bytes], pdu: bytes) -> None:
    made = bench()
    framed = bytes.fromhex("0001 0000") + (len(pdu) + 1).to_bytes(2, "big") + b"\x01" + pdu
    for piece in [framed, *pieces]:
        made.ask(piece)
    inside = {"setpoint", "ramp", "door", "start"}
    assert all(event.keys() <= inside for event in made.written)
    assert ask(bench(), "03 0000 0001") == "03 02 04 d2"


def test_a_master_reads_and_writes_arrays() -> None:
    tags = {
        "steps": {"address": "holding:20", "type": "int16[2]", "source": "mixer/steps"},
        "order": {"address": "holding:100", "type": "uint16[3]"},
    }
    made = Bench("tcp://127.0.0.1:5020", {"hmi": {**HMI, "tags": tags}})
    assert ask(made, "03 0014 0002") == "83 04"
    made.values["mixer/steps"] = (1.4, -2.6)
    assert ask(made, "03 0014 0002") == "03 04 00 01 ff fd"
    assert ask(made, "03 0015 0001") == "03 02 ff fd"
    assert ask(made, "10 0064 0003 06 0001 0002 ffff") == "10 00 64 00 03"
    assert made.written == [{"order": (1, 2, 65535)}]
    # Some of its words would join parts of two arrays.
    assert ask(made, "10 0064 0002 04 0003 0004") == "90 02"
    assert ask(made, "06 0065 0009") == "86 02"
    assert made.written == [{"order": (1, 2, 65535)}]
    assert ask(made, "03 0064 0003") == "03 06 00 01 00 02 ff ff"
