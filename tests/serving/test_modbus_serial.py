"""Modbus RTU and ASCII stations of the gateway on a wire that they may share."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.protocols.checksums import crc16, lrc
from gateway.stations.served.modbus_wire import RtuReader
from gateway.tags import Quality
from tests.serving.bench import Bench

TAGS = {
    "speed": {"address": "holding:0", "source": "mixer/speed"},
    "setpoint": {"address": "holding:4"},
    "second": {"address": "holding:5"},
    "start": {"address": "coil:2"},
}
STATION = {"protocol": "modbus-rtu", "accept": ["holding:4..holding:9", "coil:0..coil:9"]}


def bench(protocol: str = "modbus-rtu", **line: object) -> Bench:
    one = {**STATION, "protocol": protocol, "station": 1, "tags": TAGS}
    two = {
        **STATION,
        "protocol": protocol,
        "station": 2,
        "tags": {"word": {"address": "holding:4"}},
    }
    made = Bench("/dev/ttyS98", {"one": one, "two": two}, **line)
    made.values = {"mixer/speed": 0x1234}
    return made


def rtu(text: str) -> bytes:
    body = bytes.fromhex(text)
    return body + crc16(body)


def ascii_frame(text: str) -> bytes:
    body = bytes.fromhex(text)
    return b":" + body.hex().upper().encode() + b"%02X\r\n" % lrc(body)


READ, VALUE = rtu("01 03 0000 0001"), rtu("01 03 02 1234")


def test_the_examples_of_the_ex485lnk_manual() -> None:
    """FC 10h in RTU and ASCII, and its broadcasts, which no station answers."""
    write, broadcast = "01 10 0004 0002 04 4321 8765", "00 10 0004 0002 04 4321 8765"
    for protocol, frame in (("modbus-rtu", rtu), ("modbus-ascii", ascii_frame)):
        made = bench(protocol)
        assert made.ask(frame(write)) == frame("01 10 0004 0002")
        assert made.written == [{"setpoint": 0x4321, "second": 0x8765}]
        assert made.ask(frame(broadcast)) == b""
        assert made.written[1:] == [{"setpoint": 0x4321, "second": 0x8765}, {"word": 0x4321}]
    assert ascii_frame(write) == b":0110000400020443218765" + b"95\r\n"
    assert ascii_frame(broadcast) == b":0010000400020443218765" + b"96\r\n"


def test_an_rtu_reply_comes_after_the_silence_of_the_standard() -> None:
    assert bench().hear(READ).delay == pytest.approx(3.5 * 11 / 9600)
    assert bench(baudrate=115200, format="8E1").hear(READ).delay == 0.00175
    assert bench("modbus-ascii").hear(ascii_frame("01 03 0000 0001")).delay == 0


@pytest.mark.parametrize("place", range(8))
def test_a_damaged_frame_is_not_answered(place: int) -> None:
    made, damaged = bench(), bytearray(rtu("01 06 0004 0001"))
    damaged[place] ^= 0x10
    assert made.ask(bytes(damaged)) == b""
    assert made.written == []
    assert made.ask(READ) == VALUE


def test_a_damaged_ascii_frame_is_not_answered() -> None:
    made, frame = bench("modbus-ascii"), ascii_frame("01 06 0004 0001")
    cut = (frame[:-3] + b"0\r\n", frame[1:], b":" + frame[3:])
    for damaged in (frame.replace(b"04", b"05"), *cut):
        assert made.ask(damaged) == b""
    assert made.written == []


def test_other_stations_are_ignored_with_their_replies() -> None:
    made = bench()
    assert made.ask(rtu("03 06 0004 0001")) == b""
    assert made.ask(rtu("03 06 0004 0001"), after=0.01) == b""  # the reply is equal
    assert made.ask(rtu("03 03 0000 0004"), after=0.01) == b""
    # The reply holds a request to station 1, with its check sum.
    assert made.ask(rtu("03 03 08" + rtu("01 06 0004 0007").hex()), after=0.01) == b""
    assert made.ask(rtu("03 10 0004 0001 02 0007"), after=0.01) == b""
    assert made.ask(rtu("03 10 0004 0001") + READ, after=0.01) == VALUE
    assert made.written == []
    assert made.ask(READ, after=0.005) == VALUE


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("03 03 0000 0004", "03 03 08" + rtu("01 06 0004 0007").hex()),
        ("09 01 0000 0030", "09" + rtu("01 06 0004 0007").hex()),  # 48 coils, from the function on
    ],
)
def test_the_reply_of_another_station_in_pieces_is_no_request(request_: str, reply: str) -> None:
    made, whole = bench(), rtu(request_) + rtu(reply)
    for size in (1, 3, 11):  # with the pauses of an adapter
        for at in range(0, len(whole), size):
            assert made.ask(whole[at : at + size], after=0.006) == b""
        assert made.ask(READ, after=0.006) == VALUE
    assert made.written == []


def test_a_request_in_pieces_is_answered_once() -> None:
    made = bench()
    replies = [made.ask(bytes((byte,)), after=0.006) for byte in READ]
    assert replies == [b""] * 7 + [VALUE]


def test_a_frame_after_half_a_frame_and_a_silence_is_heard() -> None:
    made = bench()
    assert made.ask(rtu("01 06 0004 0007")[:5]) == b""
    assert made.ask(READ, after=0.02) == VALUE


def test_two_bytes_of_noise_before_or_behind_a_request_do_no_harm() -> None:
    made = bench()
    assert made.ask(b"\xff\x00" + READ) == VALUE
    assert made.ask(READ + b"\x00\xff") == VALUE


def test_noise_is_skipped_after_a_silence_only() -> None:
    made = bench()
    assert made.ask(READ) == VALUE
    assert made.ask(b"\xff\x00" + READ, after=0.01) == VALUE  # no pause that begins all again
    assert made.ask(b"\xff" + READ, after=0.001) == b""


def test_a_request_that_another_follows_is_neither_done_nor_answered() -> None:
    """The master no longer waits, and would take the reply for that to its next request."""
    made = bench()
    late = made.hear(rtu("01 06 0004 0007") + READ)
    assert late.reply == VALUE
    assert late.stale == 1
    assert made.written == []
    begun = made.hear(rtu("01 06 0004 0007") + READ[:4])
    assert begun.reply == b""
    assert made.written == []
    assert made.line.stale == 2


def test_the_echo_of_a_reply_is_no_request() -> None:
    made, write = bench(), rtu("01 06 0004 0007")
    assert made.ask(READ) == VALUE
    assert made.ask(VALUE, after=0.02) == b""
    assert made.ask(write) == write
    assert made.ask(write, after=0.02) == b""  # its echo
    assert made.ask(READ) == VALUE
    assert made.written == [{"setpoint": 7}]


@pytest.mark.parametrize("baudrate", [300, 600, 1200])
def test_a_request_in_pieces_is_answered_on_a_slow_wire(baudrate: int) -> None:
    character = 11 / baudrate
    for made, request, reply in (
        (bench(baudrate=baudrate), READ, VALUE),
        (_vigor(baudrate), *_VIGOR),
    ):
        pieces = [request[at : at + 3] for at in range(0, len(request), 3)]
        heard = [made.ask(one, after=0.04 + 3 * character) for one in pieces]
        assert heard == [b""] * (len(pieces) - 1) + [reply]


_VIGOR = (b"\x0205511C0002\x0304", b"\x060551003412\x03F8")


def _vigor(baudrate: int) -> Bench:
    tags = {"speed": {"address": "D0", "source": "mixer/speed"}}
    plc = {"protocol": "vigor", "station": 5, "tags": tags}
    made = Bench("/dev/ttyS98", {"plc": plc}, baudrate=baudrate)
    made.values = {"mixer/speed": 0x1234}
    return made


def test_the_pauses_of_a_telephone_line_and_of_the_file_do_no_harm() -> None:
    half, rest = rtu("01 06 0004 0007")[:5], rtu("01 06 0004 0007")[5:]
    call = {"port": "modem:/dev/ttyS98"}
    slow = bench(request_gap="300ms")
    dialled = Bench(call["port"], {"one": {**STATION, "station": 1, "tags": TAGS}})
    dialled.values = {"mixer/speed": 0x1234}
    for made, pause, longer in ((slow, 0.25, 0.35), (dialled, 1.5, 2.5)):
        assert made.ask(half) == b""
        assert made.ask(rest, after=pause) == half + rest
        assert made.ask(half) == b""
        assert made.ask(rest, after=longer) == b""
        assert made.ask(half) == b""
        assert made.ask(READ, after=pause) == VALUE  # the master gave up, and asks again
        assert len(made.written) == 1


def test_a_repeated_write_is_done_again_on_a_line_without_echo() -> None:
    made, write = bench(), rtu("01 06 0004 0007")
    assert made.ask(READ) == VALUE
    assert made.ask(READ, after=0.02) == VALUE  # so the adapter does not echo
    assert [made.ask(write, after=0.02) for _ in range(3)] == [write] * 3
    assert made.written == [{"setpoint": 7}] * 3


def test_an_unknown_function_is_refused_and_the_next_request_answered() -> None:
    made = bench()
    assert made.ask(rtu("01 2b 0e 01 00")) == rtu("01 ab 01")
    assert made.ask(rtu("03 2b 0e 01 00")) == b""
    assert made.ask(READ, after=0.01) == VALUE


def test_a_vigor_master_finds_the_addresses_of_its_maker() -> None:
    """MBUS: D0 is register 0, C200 two registers from 8648 on, M0 coil 512."""
    tags = {
        "order": {"address": "D0"},
        "count": {"address": "C200"},
        "lamp": {"address": "M0"},
        "speed": {"address": "T1", "source": "mixer/speed"},
    }
    plc = {"protocol": "modbus-rtu", "station": 9, "addressing": "vigor", "tags": tags}
    made = Bench("/dev/ttyS98", {"plc": {**plc, "accept": ["D0", "C200", "M0..M7"]}})
    made.values = {"mixer/speed": 0x1234}
    assert made.ask(rtu("09 10 21c8 0002 04 5678 1234")) == rtu("09 10 21c8 0002")
    assert made.ask(rtu("09 06 21c8 5678")) == rtu("09 86 02")  # one half
    assert made.ask(rtu("09 05 0200 ff00")) == rtu("09 05 0200 ff00")
    assert made.ask(rtu("09 04 2001 0001")) == rtu("09 04 02 1234")
    assert made.ask(rtu("09 03 21c9 0001")) == rtu("09 03 02 1234")
    assert made.written == [{"count": 0x12345678}, {"lamp": True}]


def test_an_ex485lnk_gets_10_ms_of_silence() -> None:
    plc = {"protocol": "modbus-rtu", "station": 1, "addressing": "ex485lnk"}
    plc["tags"] = {"speed": {"address": "BFM#0", "source": "mixer/speed"}}
    made = Bench("/dev/ttyS98", {"plc": plc})
    made.values = {"mixer/speed": 0x1234}
    assert made.hear(READ).delay == 0.010
    plc["turnaround"] = "2ms"
    assert Bench("/dev/ttyS98", {"plc": plc}).hear(READ).delay == 0.002


@settings(max_examples=40)
@given(st.lists(st.tuples(st.binary(max_size=20), st.sampled_from([0.0, 0.001, 0.01, 1.0]))))
def test_any_bytes_at_any_time_are_answered_only_where_a_sound_request_is(
    pieces: list[tuple[bytes, float]],
) -> None:
    made = bench()
    for data, after in pieces:
        heard = made.hear(data, after=after)
        assert not heard.reply or heard.reply[0] in (1, 2)
    assert all(sample.quality is Quality.GOOD for event in made.samples_given for sample in event)
    assert made.ask(READ, after=0.06) == VALUE


def _frames() -> st.SearchStrategy[bytes]:
    word = st.integers(0, 255).map(lambda n: f"{n:04x}")
    station = st.sampled_from(["01", "02", "03", "07"])
    request = st.tuples(station, st.sampled_from(["03", "06", "01"]), word, word)
    reply = st.tuples(station, st.just("03 04"), word, word)
    frames = st.one_of(request, reply).map(lambda parts: rtu(" ".join(parts)))
    return frames.filter(lambda frame: not _begins_with_another(frame))


def _begins_with_another(frame: bytes) -> bool:
    """One reply in 65,536 begins with a sound frame: until the next silence it misleads."""
    return any(crc16(frame[: size - 2]) == frame[size - 2 : size] for size in range(4, len(frame)))


@settings(max_examples=40)
@given(st.lists(_frames(), min_size=1, max_size=6), st.integers(1, 9))
def test_frames_are_found_however_they_are_cut(frames: list[bytes], size: int) -> None:
    wire = bench().line.machine()._wire  # type: ignore[attr-defined]
    reader = RtuReader({}, wire)
    data, found = b"".join(frames), 0
    for at in range(0, len(data), size):
        found += len(reader.feed(data[at : at + size], 100 + at * 0.001))
    assert found == len(frames)
