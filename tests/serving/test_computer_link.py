"""Computer Link stations of the gateway, formats 1 and 4: examples of the manual, and errors."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.config import ConfigErrors
from tests.serving.bench import Bench

TAGS = {
    **{f"m{n}": {"address": f"M{n:04d}", "write": True} for n in range(10, 15)},
    **{f"b{n}": {"address": f"M{n:04d}"} for n in range(640, 650)},
    "speed": {"address": "D0100", "source": "mixer/speed"},
    "order": {"address": "D0000", "type": "int32"},
    "third": {"address": "D0500"},
    "counter": {"address": "CN200"},
    "lamp": {"address": "Y0001"},
}
ACCEPT = ["D0000..D0001", "D0500", "M0640..M0671", "CN200", "Y0001"]
STATION = {"protocol": "computer-link", "accept": ACCEPT, "tags": TAGS}


def bench(frame_format: int = 1, *, sum_check: bool = True) -> Bench:
    one = {**STATION, "station": 5, "frame_format": frame_format, "sum_check": sum_check}
    made = Bench("/dev/ttyS98", {"plc": one})
    made.values = {f"plc/m{n}": n in (11, 12, 14) for n in range(10, 15)} | {"mixer/speed": 4660}
    return made


def request(text: str, frame_format: int = 1, *, sum_check: bool = True) -> bytes:
    """`05FFBR0M001005`, with ENQ, sum and end."""
    check = f"{sum(map(ord, text)) & 0xFF:02X}" if sum_check else ""
    return f"\x05{text}{check}".encode() + b"\r\n" * (frame_format == 4)


def block(text: str, frame_format: int = 1) -> bytes:
    """A data block: `05FF1234`, with STX, ETX, sum and end."""
    check = sum(map(ord, text + "\x03")) & 0xFF
    return f"\x02{text}\x03{check:02X}".encode() + b"\r\n" * (frame_format == 4)


@pytest.mark.parametrize("frame_format", [1, 4])
def test_2_1_reads_five_points_from_m10(frame_format: int) -> None:
    end = b"\r\n" * (frame_format == 4)
    made = bench(frame_format)
    heard = made.hear(b"\x0505FFBRAM00100539" + end)
    assert heard.reply == b"\x0205FF01101\x03E7" + end
    assert heard.delay == 0.1  # the message wait


def test_the_two_commands_of_the_ex485lnk_in_format_4() -> None:
    made = bench(4)
    assert made.ask(request("05FFWR0D010001", 4)) == block("05FF1234", 4)
    assert made.ask(request("05FFWW0D000002FFFEFFFF", 4)) == b"\x0605FF\r\n"
    assert made.written == [{"order": -2}]


def test_without_sum_check_blocks_have_no_sum() -> None:
    made = bench(sum_check=False)
    assert made.ask(request("05FFWR0D010001", sum_check=False)) == b"\x0205FF1234\x03"


def test_points_in_words_and_scattered_writes() -> None:
    made = bench()
    assert made.ask(request("05FFWW0M06400200050000")) == b"\x0605FF"
    assert made.written == [{f"b{n}": n in (640, 642) for n in range(640, 650)}]
    assert made.ask(request("05FFWR0M064002")) == block("05FF00050000")
    assert made.ask(request("05FFBT002Y00011M06411")) == b"\x0605FF"
    assert made.written[1:] == [{"lamp": True, "b641": True}]
    assert made.ask(request("05FFWT002D05001234M06400001")) == b"\x0605FF"
    assert made.written[2]["third"] == 0x1234
    assert made.written[2]["b640"] is True
    assert made.ask(request("05FFWW0CN2000112345678")) == b"\x0605FF"
    assert made.written[3:] == [{"counter": 0x12345678}]


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("05FFXX0D010001", "03"),
        ("05FFWRGD010001", "06"),
        ("05FFWR0D010101", "06"),  # no tag
        ("05FFWR0D010002", "06"),  # the second has none
        ("05FFWR0D050001", "06"),  # not written yet
        ("05FFWW0D0100010001", "06"),  # not accepted
        ("05FFWW0D0000010001", "06"),  # one half of 32 bits
        ("05FFBW0M0010011", "06"),
        ("05FFWW0D050001000G", "07"),
        ("05FEWR0D010001", "10"),
        ("05FFRR0", "18"),
        ("05FFRS0", "18"),
        ("05FFMB0", "06"),
    ],
)
def test_everything_else_gets_the_code_of_the_manual(text: str, code: str) -> None:
    made = bench()
    assert made.ask(request(text)) == f"\x1505FF{code}".encode()
    assert made.written == []


def test_2_10_lists_that_a_master_registers_are_read_by_mb_and_mn() -> None:
    made = bench()
    for text in ("05FFMB0", "05FFMN0", "05FFBM002M0010M0099", "05FFWM001D0101"):
        assert made.ask(request(text)) == b"\x1505FF06"  # no list yet; no tag at M99 and D101
    assert made.ask(request("05FFBM003M0010M0011M0012")) == b"\x0605FF"
    assert made.ask(request("05FFWM002D0100D0500")) == b"\x0605FF"
    assert made.ask(request("05FFMB0")) == block("05FF011")
    assert made.ask(request("05FFMN0")) == b"\x1505FF06"  # D500 is not written yet
    assert made.ask(request("05FFWW0D050001ABCD")) == b"\x0605FF"
    assert made.ask(request("05FFMN0")) == block("05FF1234ABCD")
    assert made.ask(request("05FFPC0")) == block("05FF9E")


def test_2_11_and_2_12_run_stop_and_the_global_flag_are_tags_where_the_master_may_write() -> None:
    tags = {
        "runs": {"address": "M8035"},
        "stops": {"address": "M8037"},
        "all": {"address": "M8126"},
    }
    plc = {"protocol": "computer-link", "accept": ["M8035..M8037", "M8126"], "tags": tags}
    made = Bench("/dev/ttyS98", {"a": {**plc, "station": 5}, "b": {**plc, "station": 6}})
    assert made.ask(request("05FFRS0")) == b"\x0605FF"
    assert made.ask(request("05FFRS0")) == b"\x1505FF18"
    assert made.ask(request("05FFRR0")) == b"\x0605FF"
    assert made.ask(request("05FFRR0")) == b"\x1505FF18"
    stopped = {"runs": False, "stops": True}
    assert made.written == [{**stopped, "all": False}, {"runs": True, "stops": False}]
    assert made.ask(request("FFFFGW01")) == made.ask(request("05FFGW00")) == b""
    assert made.written[2:] == [{"all": True}, {"all": True}, {"all": False}]


def test_a_wrong_sum_gets_nak_02_and_other_stations_get_silence() -> None:
    made = bench(4)
    assert made.ask(b"\x0505FFWW0D05000112340\x00\r\n") == b"\x1505FF02\r\n"
    assert made.ask(request("06FFWR0D010001", 4)) == b""
    assert made.ask(b"\x0206FF1234\x0395\r\n") == b""
    assert made.ask(request("FFFFGW01", 4)) == b""
    assert made.ask(request("05FFGW01", 4)) == b""
    assert made.ask(b"\x0605FF\r\n") == b""  # the master acknowledges
    assert made.written == []
    assert made.ask(request("05FFTT005ABCDE", 4)) == block("05FF05ABCDE", 4)


def test_half_a_request_and_a_late_end_are_no_request() -> None:
    made, write = bench(), request("05FFWW0D0500011234")
    assert made.ask(write[:10]) == b""
    assert made.ask(write[10:], after=0.2) == b""
    assert made.ask(write[:10]) == b""
    assert made.ask(write[10:], after=0.05) == b"\x0605FF"
    assert made.written == [{"third": 0x1234}]


def test_a_request_that_another_follows_is_neither_done_nor_answered() -> None:
    made, write = bench(), request("05FFWW0D0500011234")
    assert made.ask(write + request("06FFWR0D010001")) == b""
    assert made.ask(write + write[:6]) == b""
    assert made.written == []


def test_the_stations_of_a_line_have_one_format() -> None:
    devices: dict[str, Any] = {
        "a": {**STATION, "station": 1},
        "b": {**STATION, "station": 2, "frame_format": 4},
    }
    with pytest.raises(ConfigErrors, match="a on this line has 1: all stations of a line"):
        Bench("/dev/ttyS98", devices)


@settings(max_examples=40)
@given(
    st.lists(st.one_of(st.binary(max_size=16), st.sampled_from([b"\x05", b"05FF", b"WW0", b"02"]))),
    st.sampled_from([1, 4]),
)
def test_any_bytes_write_nothing(pieces: list[bytes], frame_format: int) -> None:
    made = bench(frame_format)
    for piece in pieces:
        made.hear(piece, after=0.01)
    assert made.written == []
    read = request("05FFWR0D010001", frame_format)
    assert made.ask(read)[:9] == b"\x0205FF1234"


@settings(max_examples=40)
@given(st.integers(0, 20), st.integers(1, 255))
def test_a_damaged_write_is_never_done(place: int, flip: int) -> None:
    made, damaged = bench(4), bytearray(request("05FFWW0D0500011234", 4))
    damaged[place] ^= flip
    assert made.ask(bytes(damaged))[:1] in (b"", b"\x15")
    assert made.written == []
