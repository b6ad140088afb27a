"""The Computer Link driver, against the examples of the Liyan manual, chapter 2."""

import re
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from gateway.config import load
from gateway.errors import BadValue, ConfigError, DeviceError, Garbled, NoReply, Refusal, Refused
from gateway.protocols.capabilities import Controllable, Monitor, ScatteredWriter
from gateway.protocols.computer_link import NO_REPLY_CAUSES, ComputerLink, Enquiry, Frame, Text
from gateway.protocols.computer_link.devices import ProfileName
from gateway.protocols.driver import Address, Cost, Driver, Span
from tests.doubles import Script, Wire
from tests.protocols.computer_link_peer import PROCEDURES, FrameFormat, Peer, Procedure
from tests.vectors import vectors

VECTORS = {vector.id: vector.frame for vector in vectors("fxlink")}


def sends(block: bytes) -> str:
    return f"> {block.hex(' ')}"


def hears(block: bytes) -> str:
    return f"< {block.hex(' ')}"


def vector(number: str) -> bytes:
    return VECTORS[f"fxlink-{number}"]


# The manual's examples. Requests that are no vector are rebuilt from the manual's parameters.


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "reply"), [(1, True, "057"), (1, False, "059"), (4, False, "076")]
)
async def test_2_1_reads_five_points_with_100_ms_wait(
    frame_format: FrameFormat, sum_check: bool, reply: str
) -> None:
    driver = ComputerLink(
        station=5, frame_format=frame_format, sum_check=sum_check, message_wait=0.1
    )
    request = Peer(5, frame_format, sum_check).enq("05FFBRATS01005")
    talk = Script(driver, sends(request), hears(vector(reply)))
    assert list(await driver.read(talk, Span("TS", 10, 5))) == [0, 1, 1, 0, 1]
    assert driver.cost(Span("TS", 10, 5)) == Cost(len(request), len(vector(reply)))
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"), [(1, True, "001"), (1, False, "002"), (4, True, "003")]
)
async def test_2_1_the_five_points_m10_to_m14_cost_less_as_one_word_from_m8(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(
        station=5, frame_format=frame_format, sum_check=sum_check, message_wait=0.1
    )
    peer = Peer(5, frame_format, sum_check)
    assert peer.enq("05FFBRAM001005") == vector(number)
    by_word = Script(driver, sends(peer.enq("05FFWRAM000801")), hears(peer.stx("0058")))
    assert list(await driver.read(by_word, Span("M", 10, 5))) == [0, 1, 1, 0, 1]
    by_word.done()
    by_bit = Script(driver, sends(peer.enq("05FFBRAM001004")), hears(peer.stx("0110")))
    assert list(await driver.read(by_bit, Span("M", 10, 4))) == [0, 1, 1, 0]
    by_bit.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"), [(1, True, "005"), (1, False, "006"), (4, True, "007")]
)
async def test_2_2_example_1_reads_m40_to_m71_as_two_words(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(
        station=5, frame_format=frame_format, sum_check=sum_check, message_wait=0.1
    )
    reply = Peer(5, frame_format, sum_check).stx("8001F000")
    talk = Script(driver, sends(vector(number)), hears(reply))
    expected = [1] + [0] * 14 + [1] + [0] * 12 + [1] * 4
    assert list(await driver.read(talk, Span("M", 40, 32))) == expected
    assert talk.replies == [len(reply)]
    talk.done()


async def test_2_2_example_2_reads_the_current_values_of_t123_and_t124() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    talk = Script(driver, sends(peer.enq("05FFWR0TN12302")), hears(peer.stx("7BA41234")))
    assert list(await driver.read(talk, Span("T", 123, 2))) == [0x7BA4, 0x1234]
    talk.done()


async def test_2_2_example_3_reads_d100_and_d101_of_station_15() -> None:
    driver = ComputerLink(station=15, frame_format=4)
    talk = Script(driver, sends(vector("105")), hears(vector("106")))
    assert list(await driver.read(talk, Span("D", 100, 2))) == [0x1234, 0x5678]
    talk.done()


@pytest.mark.parametrize(("frame_format", "reply"), [(1, "063"), (4, "080")])
async def test_1_6_2_c200_is_one_device_with_its_high_word_first(
    frame_format: FrameFormat, reply: str
) -> None:
    driver, peer = ComputerLink(frame_format=frame_format), Peer(0, frame_format, True)
    talk = Script(driver, sends(peer.enq("00FFWR0CN20001")), hears(vector(reply)))
    assert list(await driver.read(talk, Span("C32", 200, 1))) == [0x12345678]
    talk.done()
    assert Peer(0, 1, True).enq("00FFWR0CN20001") == vector("093")


async def test_2_3_a_writes_m903_to_m907() -> None:
    driver, peer = ComputerLink(), Peer(0, 1, True)
    talk = Script(driver, sends(peer.enq("00FFBW0M09030501101")), hears(peer.ack()))
    assert await driver.write(talk, Span("M", 903, 5), [0, 1, 1, 0, 1]) is True
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"),
    [(1, True, "009"), (1, False, "010"), (4, True, "011"), (4, False, "012")],
)
async def test_2_3_b_writes_m8030_and_m8031_of_station_8(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(
        station=8, frame_format=frame_format, sum_check=sum_check, message_wait=0.01
    )
    talk = Script(driver, sends(vector(number)), hears(Peer(8, frame_format, sum_check).ack()))
    assert await driver.write(talk, Span("M8", 8030, 2), [1, 0]) is True
    talk.done()


async def test_2_4_example_1_writes_m640_to_m671_as_two_words() -> None:
    driver, peer = ComputerLink(), Peer(0, 1, True)
    talk = Script(driver, sends(peer.enq("00FFWW0M06400223478001")), hears(peer.ack()))
    bits = [int(bit) for word in (0x2347, 0x8001) for bit in reversed(f"{word:016b}")]
    assert await driver.write(talk, Span("M", 640, 32), bits) is True
    talk.done()


async def test_2_4_example_2_writes_d0_and_d1() -> None:
    driver = ComputerLink(frame_format=4)
    talk = Script(driver, sends(vector("107")), hears(Peer(0, 4, True).ack()))
    assert await driver.write(talk, Span("D", 0, 2), [0x1234, 0x5678]) is True
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"),
    [(1, True, "013"), (1, False, "014"), (4, True, "015"), (4, False, "016")],
)
async def test_2_4_example_3_writes_d8130_and_d8131(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(frame_format=frame_format, sum_check=sum_check)
    talk = Script(driver, sends(vector(number)), hears(Peer(0, frame_format, sum_check).ack()))
    assert await driver.write(talk, Span("D8", 8130, 2), [1, 2]) is True
    talk.done()


async def test_2_4_c200_is_written_as_one_device_of_eight_digits() -> None:
    driver = ComputerLink()
    talk = Script(driver, sends(vector("104")), hears(Peer(0, 1, True).ack()))
    assert await driver.write(talk, Span("C32", 200, 1), [0x12345]) is True
    talk.done()


async def test_2_5_sets_m50_resets_s100_sets_y1_in_one_bt() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    talk = Script(driver, sends(peer.enq("05FFBT003M00501S01000Y00011")), hears(peer.ack()))
    parts = [(Span("M", 50, 1), [1]), (Span("S", 100, 1), [0]), (Span("Y", 1, 1), [1])]
    assert await driver.write_scattered(talk, parts) is True
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"), [(1, False, "018"), (4, True, "019")]
)
async def test_2_5_x_and_y_are_numbered_in_octal(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(station=5, frame_format=frame_format, sum_check=sum_check)
    talk = Script(driver, sends(vector(number)), hears(Peer(5, frame_format, sum_check).ack()))
    parts = [(Span("X", 0, 1), [1]), (Span("Y", 0o17, 1), [0])]
    assert await driver.write_scattered(talk, parts) is True
    talk.done()


async def test_2_6_writes_d500_y100_to_y117_and_c100_in_one_wt() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    block = peer.enq("05FFWT003D05001234Y0100BCA9CN1000064")
    talk = Script(driver, sends(block), hears(peer.ack()))
    bits = [int(bit) for bit in reversed(f"{0xBCA9:016b}")]
    parts = [
        (Span("D", 500, 1), [0x1234]),
        (Span("Y", 0o100, 16), bits),
        (Span("C", 100, 1), [100]),
    ]
    assert await driver.write_scattered(talk, parts) is True
    assert driver.scattered_write_cost([span for span, _ in parts]) == Cost(len(block), 5)
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"),
    [(1, True, "021"), (1, False, "022"), (4, True, "023"), (4, False, "024")],
)
async def test_2_6_a_word_and_sixteen_states_go_in_one_wt(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(station=5, frame_format=frame_format, sum_check=sum_check)
    talk = Script(driver, sends(vector(number)), hears(Peer(5, frame_format, sum_check).ack()))
    parts = [(Span("D", 123, 1), [0xFF]), (Span("S", 0, 16), [1] + [0] * 14 + [1])]
    assert await driver.write_scattered(talk, parts) is True
    talk.done()


BITS = [Span("X", 0, 1), Span("Y", 0o17, 1), Span("TS", 123, 1)]
WORDS = [Span("D", 500, 1), Span("Y", 0o100, 16), Span("C", 100, 1)]


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"),
    [(1, True, "025"), (1, False, "026"), (4, False, "028")],
)
async def test_2_7_registers_three_points(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(station=5, frame_format=frame_format, sum_check=sum_check, monitor=True)
    talk = Script(driver, sends(vector(number)), hears(Peer(5, frame_format, sum_check).ack()))
    await driver.register(talk, BITS)
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"),
    [(1, True, "029"), (1, False, "030"), (4, True, "031"), (4, False, "032")],
)
async def test_2_8_registers_three_words(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(station=5, frame_format=frame_format, sum_check=sum_check, monitor=True)
    talk = Script(driver, sends(vector(number)), hears(Peer(5, frame_format, sum_check).ack()))
    await driver.register(talk, WORDS)
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "request_", "reply"), [(1, "033", "061"), (4, "035", "078")]
)
async def test_2_9_reads_the_registered_points(
    frame_format: FrameFormat, request_: str, reply: str
) -> None:
    driver = ComputerLink(station=8, frame_format=frame_format, monitor=True)
    talk = Script(driver, sends(vector(request_)), hears(vector(reply)))
    assert [list(units) for units in await driver.read_registered(talk, BITS)] == [[1], [0], [1]]
    assert driver.monitor_cost(BITS) == Cost(len(vector(request_)), len(vector(reply)))
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "request_", "reply"),
    [(1, False, "038", "060"), (4, True, "039", "075"), (4, False, "040", "077")],
)
async def test_2_10_reads_the_registered_words(
    frame_format: FrameFormat, sum_check: bool, request_: str, reply: str
) -> None:
    driver = ComputerLink(station=8, frame_format=frame_format, sum_check=sum_check, monitor=True)
    spans = [Span("D", 500, 1), Span("C", 100, 1), Span("D", 7, 1)]
    talk = Script(driver, sends(vector(request_)), hears(vector(reply)))
    read = await driver.read_registered(talk, spans)
    assert [list(units) for units in read] == [[0x1234], [0x64], [0xBCA9]]
    assert driver.monitor_cost(spans) == Cost(len(vector(request_)), len(vector(reply)))
    talk.done()


async def test_2_10_a_plc_with_the_misprinted_command_gets_mw() -> None:
    driver = ComputerLink(station=8, monitor=True, monitor_word_command="MW")
    peer = Peer(8, 1, True)
    talk = Script(driver, sends(peer.enq("08FFMW0")), hears(peer.stx("1234")))
    assert [list(units) for units in await driver.read_registered(talk, [Span("D", 1, 1)])] == [
        [0x1234]
    ]
    talk.done()


@pytest.mark.parametrize("data", ["12340064", "12340064BCA90001", "12340064BCA", ""])
async def test_2_10_a_list_of_another_length_is_no_answer(data: str) -> None:
    driver, peer = ComputerLink(station=8, monitor=True), Peer(8, 1, True)
    talk = Script(driver, sends(peer.enq("08FFMN0")), hears(peer.stx(data)))
    with pytest.raises(Garbled):
        await driver.read_registered(talk, WORDS)


@pytest.mark.parametrize(
    ("span", "block"),
    [
        (Span("M", 8, 16), "00FFWW0M0008018001"),
        (Span("M", 4, 16), "00FFBW0M0004101000000000000001"),
        (Span("Y", 0o10, 16), "00FFWW0Y0010018001"),
        (Span("TS", 8, 16), "00FFBW0TS008101000000000000001"),
    ],
    ids=str,
)
async def test_points_are_written_in_words_only_from_a_multiple_of_8(
    span: Span, block: str
) -> None:
    driver, peer = ComputerLink(), Peer(0, 1, True)
    units = [1] + [0] * 14 + [1]
    talk = Script(driver, sends(peer.enq(block)), hears(peer.ack()))
    assert await driver.write(talk, span, units) is True
    talk.done()
    assert driver.write_cost(span) == Cost(len(peer.enq(block)), 5)


def test_scattered_points_go_as_a_word_only_from_a_multiple_of_8() -> None:
    driver = ComputerLink()
    beside = Span("D", 0, 1)
    assert driver.scattered_write_cost([Span("M", 8, 16), beside]) == Cost(8 + 2 + 2 * 9 + 2, 5)
    assert driver.scattered_write_cost([Span("M", 4, 16), beside]) is None


@pytest.mark.parametrize(("command", "code"), [("run", "RR"), ("stop", "RS")])
async def test_2_11_remote_run_of_station_5_and_stop_of_station_0(command: str, code: str) -> None:
    station = 5 if command == "run" else 0
    driver, peer = ComputerLink(station=station), Peer(station, 1, True)
    talk = Script(driver, sends(peer.enq(f"{station:02X}FF{code}0")), hears(peer.ack()))
    assert await driver.control(talk, command, "") == "acknowledged"
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "command", "number"),
    [
        (1, True, "run", "041"),
        (1, False, "run", "042"),
        (4, True, "run", "043"),
        (4, False, "run", "044"),
        (1, True, "stop", "045"),
        (4, True, "stop", "047"),
        (4, False, "stop", "048"),
    ],
)
async def test_2_11_remote_run_and_stop_of_station_31(
    frame_format: FrameFormat, sum_check: bool, command: str, number: str
) -> None:
    driver = ComputerLink(station=31, frame_format=frame_format, sum_check=sum_check)
    talk = Script(driver, sends(vector(number)), hears(Peer(31, frame_format, sum_check).ack()))
    await driver.control(talk, command, "")
    talk.done()


async def test_2_11_remote_run_while_running_is_refused_with_18() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    talk = Script(driver, sends(peer.enq("05FFRR0")), hears(vector("073")))
    with pytest.raises(Refused, match="not possible") as caught:
        await driver.control(talk, "run", "")
    assert caught.value.code == "18"


@pytest.mark.parametrize(
    ("frame_format", "sum_check", "number"), [(1, True, "049"), (1, False, "050"), (4, True, "051")]
)
async def test_2_12_the_global_flag_goes_to_all_stations_without_a_reply(
    frame_format: FrameFormat, sum_check: bool, number: str
) -> None:
    driver = ComputerLink(station=3, frame_format=frame_format, sum_check=sum_check)
    talk = Script(driver, sends(vector(number)))
    assert "none answers" in await driver.control(talk, "global", "off")
    assert talk.replies == []
    talk.done()


async def test_2_12_turns_the_global_flag_on() -> None:
    driver = ComputerLink()
    talk = Script(driver, sends(Peer(0, 1, True).enq("FFFFGW01")))
    await driver.control(talk, "global", "On")
    talk.done()


async def test_2_13_loopback_of_abcde() -> None:
    driver, peer = ComputerLink(), Peer(0, 1, True)
    talk = Script(driver, sends(peer.enq("00FFTT005ABCDE")), hears(peer.stx("05ABCDE")))
    assert await driver.control(talk, "loopback", "") == "ABCDE"
    talk.done()


@pytest.mark.parametrize(
    ("frame_format", "request_", "reply"), [(1, "053", "062"), (4, "055", "079")]
)
async def test_2_13_loopback_of_ten_characters(
    frame_format: FrameFormat, request_: str, reply: str
) -> None:
    driver = ComputerLink(station=1, frame_format=frame_format)
    talk = Script(driver, sends(vector(request_)), hears(vector(reply)))
    assert await driver.control(talk, "loopback", "HELLO12345") == "HELLO12345"
    talk.done()


async def test_the_model_is_reported_with_its_name() -> None:
    driver, peer = ComputerLink(), Peer(0, 1, True)
    talk = Script(driver, sends(peer.enq("00FFPC0")), hears(peer.stx("9D")))
    assert await driver.control(talk, "model", "") == "9D (FX2N)"
    talk = Script(driver, sends(peer.enq("00FFPC0")), hears(peer.stx("9D")))
    assert await driver.identify(talk, {"model"}) == {"model": ["9D", "FX2N"]}


BOUNDARIES = [
    ("094", Span("C32", 240, 16), 0.0),
    ("095", Span("X", 0o170, 1), 0.15),
    ("097", Span("TS", 255, 1), 0.0),
    ("098", Span("CS", 255, 1), 0.0),
    ("099", Span("D", 3999, 1), 0.0),
    ("100", Span("D8", 8255, 1), 0.0),
    ("102", Span("S", 999, 1), 0.0),
    ("103", Span("M", 1520, 16), 0.0),
]


@pytest.mark.parametrize(("number", "span", "wait"), BOUNDARIES, ids=str)
async def test_the_last_devices_are_requested_as_in_the_vectors(
    number: str, span: Span, wait: float
) -> None:
    driver = ComputerLink(message_wait=wait)
    talk = Script(driver, sends(vector(number)))
    with pytest.raises(NoReply):
        await driver.read(talk, span)
    talk.done()


def test_x100_to_x177_would_be_64_points_of_br_and_go_as_four_words() -> None:
    assert ComputerLink().codec().encode(Enquiry(0, "BR", "X010040")) == vector("096")
    assert ComputerLink().cost(Span("X", 0o100, 64)) == Cost(len(vector("096")), 8 + 4 * 4)


# Refusals and answers that are none


@pytest.mark.parametrize(
    ("number", "refusal"),
    [
        ("067", Refusal.DAMAGED),
        ("068", Refusal.OTHER),
        ("069", Refusal.ADDRESS),
        ("070", Refusal.OTHER),
        ("071", Refusal.OTHER),
        ("072", Refusal.OTHER),
        ("073", Refusal.OTHER),
    ],
)
@pytest.mark.parametrize("frame_format", [1, 4])
async def test_a_nak_is_refused_with_its_code_and_meaning(
    number: str, refusal: Refusal, frame_format: FrameFormat
) -> None:
    block = vector(number if frame_format == 1 else f"{int(number) + 17:03}")
    code = block[5:7].decode()
    driver, peer = ComputerLink(station=5, frame_format=frame_format), Peer(5, frame_format, True)
    read = Script(driver, sends(peer.enq("05FFWR0D010001")), hears(block))
    with pytest.raises(Refused, match=f"NAK {code}, .*error|remote") as caught:
        await driver.read(read, Span("D", 100, 1))
    assert (caught.value.code, caught.value.refusal) == (code, refusal)
    write = Script(driver, sends(peer.enq("05FFWW0D0100010001")), hears(block))
    with pytest.raises(Refused):
        await driver.write(write, Span("D", 100, 1), [1])
    assert write.replies[0] >= len(block)


def heard_before(driver: ComputerLink, *blocks: bytes) -> Script:
    peer = Peer(5, 1, True)
    request = peer.enq("05FFWR0D010001")
    return Script(driver, sends(request), *map(hears, blocks), hears(peer.stx("1234")))


@pytest.mark.parametrize(
    "block",
    [
        Peer(5, 1, True).stx("0007", pc="FE"),
        Peer(5, 1, True).enq("05FFWR0D010001"),
        Peer(4, 1, True).stx("0007"),
        Peer(4, 1, True).nak("06"),
        Peer(5, 1, True).stx("00070008"),
        Peer(5, 1, True).stx("000"),
        Peer(5, 1, True).stx("00g7"),
        Peer(5, 1, True).stx("00a7"),
        Peer(5, 1, True).ack(),
    ],
    ids=["on-demand", "echo", "station", "nak-of-4", "long", "short", "no-hex", "lower", "ack"],
)
async def test_a_block_that_is_no_answer_is_passed_over(block: bytes) -> None:
    driver = ComputerLink(station=5)
    talk = heard_before(driver, block)
    assert list(await driver.read(talk, Span("D", 100, 1))) == [0x1234]
    talk.done()


async def test_a_write_is_done_by_its_own_stations_ack_alone() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    wrong = [Peer(4, 1, True).ack(), peer.stx("1234"), peer.stx("1", pc="FE"), b"\x0605FE"]
    talk = Script(driver, sends(peer.enq("05FFBW0M0010011")), *map(hears, wrong))
    with pytest.raises(Garbled):
        await driver.write(talk, Span("M", 10, 1), [1])


def test_a_stray_block_is_described_for_the_log() -> None:
    driver = ComputerLink(station=5)
    assert driver.describe_stray(Text(5, "0007", "FE")) == "on-demand data of station 5: 0007"
    assert driver.describe_stray(Enquiry(5, "BR", "M001001")) == "echo of BR M001001"
    assert driver.describe_stray(Text(5, "0007")) is None


def test_the_causes_of_silence_name_the_plcs_own_codes() -> None:
    for code in ("6301", "6305", "6306", "D8120", "D8121", "D8129", "D8063"):
        assert code in NO_REPLY_CAUSES


async def test_resync_takes_only_the_reply_with_its_own_probe_token() -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    late = [peer.stx("05Z0006"), peer.stx("0501101"), peer.ack()]
    talk = Script(driver, sends(peer.enq("05FFTT005Z0007")), *map(hears, late))
    with pytest.raises(Garbled):
        await driver.resync(talk, Span("M", 10, 5), 7)
    talk = Script(
        driver, sends(peer.enq("05FFTT005Z0007")), *map(hears, [*late, peer.stx("05Z0007")])
    )
    await driver.resync(talk, Span("M", 10, 5), 7)
    talk.done()


@given(st.integers(0, 0xFFFF), st.sampled_from(["M", "D", "C32", "TS"]), st.integers(1, 16))
async def test_no_reply_to_a_resync_can_be_read_as_a_value(salt: int, area: str, size: int) -> None:
    driver, peer = ComputerLink(station=5), Peer(5, 1, True)
    first = driver.areas[area].first
    wire = Wire(driver, lambda _: [peer.stx(f"05Z{salt:04X}")])
    with pytest.raises(NoReply):
        await driver.read(wire, Span(area, first, size))


BLOCKS = st.builds(
    lambda fmt, summed, kind, station, text: {
        "stx": Peer(station, fmt, summed).stx(text),
        "ack": Peer(station, fmt, summed).ack(),
        "nak": Peer(station, fmt, summed).nak(text[:2].ljust(2, "0")),
        "enq": Peer(station, fmt, summed).enq(text),
    }[kind],
    st.sampled_from([1, 4]),
    st.booleans(),
    st.sampled_from(["stx", "ack", "nak", "enq"]),
    st.integers(4, 5),
    st.text("01239AFZ", max_size=12),
)
Converse = Callable[[ComputerLink, Wire], Awaitable[Any]]
CONVERSATIONS: list[Converse] = [
    lambda driver, talk: driver.read(talk, Span("D", 100, 2)),
    lambda driver, talk: driver.read(talk, Span("M", 10, 2)),
    lambda driver, talk: driver.read(talk, Span("M", 0, 30)),
    lambda driver, talk: driver.read(talk, Span("C32", 200, 1)),
    lambda driver, talk: driver.write(talk, Span("D", 100, 1), [7]),
    lambda driver, talk: driver.write_scattered(
        talk, [(Span("M", 1, 1), [1]), (Span("M", 9, 1), [1])]
    ),
    lambda driver, talk: driver.register(talk, [Span("M", 1, 1), Span("M", 9, 1)]),
    lambda driver, talk: driver.read_registered(talk, [Span("D", 1, 1), Span("D", 9, 1)]),
    lambda driver, talk: driver.control(talk, "model", ""),
    lambda driver, talk: driver.control(talk, "loopback", "1"),
    lambda driver, talk: driver.resync(talk, None, 3),
]


@settings(max_examples=150)
@given(
    st.lists(st.one_of(BLOCKS, st.binary(max_size=8)), max_size=4),
    st.sampled_from(CONVERSATIONS),
    st.sampled_from(PROCEDURES),
)
async def test_any_reply_is_a_value_or_a_device_error(
    pieces: list[bytes], converse: Converse, procedure: Procedure
) -> None:
    driver = ComputerLink(
        station=5, frame_format=procedure[0], sum_check=procedure[1], monitor=True
    )
    try:
        said = await converse(driver, Wire(driver, lambda _: pieces))
    except DeviceError:
        return
    assert said is None or said is True or len(said) > 0
    assert pieces


# Settings


@pytest.mark.parametrize(
    ("settings_", "says"),
    [
        ({"station": 32}, "0..31"),
        ({"station": -1}, "0..31"),
        ({"station": 16, "profile": "fx"}, "0..15"),
        ({"profile": "ex3"}, "ex1s"),
        ({"frame_format": 3}, "1 or 4"),
        ({"message_wait": 0.16}, "150ms"),
        ({"message_wait": -0.01}, "150ms"),
        ({"message_wait": 0.015}, "steps of 10ms"),
        ({"message_wait": float("nan")}, "150ms"),
        ({"monitor": True, "profile": "fx"}, "no monitor commands"),
        ({"monitor_word_command": "MX"}, "MN or MW"),
    ],
    ids=str,
)
def test_a_setting_out_of_range_is_a_config_error(settings_: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        ComputerLink(**settings_)


@pytest.mark.parametrize("step", range(16))
def test_1_3_2_the_message_wait_is_one_digit_of_10_ms(step: int) -> None:
    driver = ComputerLink(message_wait=step / 100)
    assert driver.timing.reply_timeout == pytest.approx(1.0 + step / 100)
    assert driver.timing.turnaround == pytest.approx(max(0.02, step / 100))


async def test_every_request_has_the_message_wait() -> None:
    driver, peer = ComputerLink(message_wait=0.15), Peer(0, 1, True)
    talk = Script(driver, sends(peer.enq("00FFWRFD000001")), hears(peer.stx("0001")))
    await driver.read(talk, Span("D", 0, 1))
    talk.done()


async def test_area_c_confirms_data_and_nothing_else() -> None:
    driver, peer = ComputerLink(station=5, send_area_c=True), Peer(5, 1, True)
    ack = vector("064")
    talk = Script(driver, sends(peer.enq("05FFWR0D000001")), hears(peer.stx("0001")), sends(ack))
    await driver.read(talk, Span("D", 0, 1))
    talk.done()
    talk = Script(driver, sends(peer.enq("05FFWW0D0000010001")), hears(peer.ack()))
    await driver.write(talk, Span("D", 0, 1), [1])
    talk.done()


def test_the_file_can_name_every_setting() -> None:
    driver = TypeAdapter(ComputerLink).validate_python(
        {
            "protocol": "computer-link",
            "station": 31,
            "profile": "ex1s",
            "frame_format": 4,
            "sum_check": False,
            "message_wait": 0.05,
            "send_area_c": True,
            "monitor": True,
            "monitor_word_command": "MW",
        }
    )
    assert driver == ComputerLink(
        station=31,
        profile="ex1s",
        frame_format=4,
        sum_check=False,
        message_wait=0.05,
        send_area_c=True,
        monitor=True,
        monitor_word_command="MW",
    )
    with pytest.raises(ValidationError, match=r"station 32 is not 0\.\.31"):
        TypeAdapter(ComputerLink).validate_python({"station": 32})


def test_the_driver_has_the_capabilities_of_the_contract() -> None:
    driver = ComputerLink()
    contract: Driver[Frame] = driver
    assert contract.protocol == "computer-link"
    assert isinstance(driver, ScatteredWriter)
    assert isinstance(driver, Monitor)
    assert isinstance(driver, Controllable)


@pytest.mark.parametrize(
    ("command", "argument"),
    [
        ("reset", ""),
        ("run", "now"),
        ("stop", "1"),
        ("model", "x"),
        ("global", ""),
        ("global", "2"),
        ("loopback", "ä"),
        ("loopback", "a\n"),
        ("loopback", "x" * 129),
    ],
)
async def test_a_command_that_cannot_be_sent_is_a_bad_value(command: str, argument: str) -> None:
    with pytest.raises(BadValue):
        await ComputerLink().control(Script(ComputerLink()), command, argument)


@pytest.mark.parametrize(
    ("span", "units"),
    [
        (Span("D", 0, 1), [0x10000]),
        (Span("D", 0, 1), [-1]),
        (Span("M", 0, 1), [2]),
        (Span("D", 0, 2), [1]),
        (Span("C32", 200, 1), [1 << 32]),
        (Span("M", 0, 16), [1] * 17),
    ],
)
async def test_units_that_do_not_fit_are_never_sent(span: Span, units: list[int]) -> None:
    driver = ComputerLink()
    with pytest.raises(BadValue):
        await driver.write(Script(driver), span, units)
    if span.area != "C32":
        with pytest.raises(BadValue):
            await driver.write_scattered(Script(driver), [(span, units)])


# Addresses


@pytest.mark.parametrize(
    ("text", "address", "spelled"),
    [
        ("D100", Address("D", 100), "D100"),
        ("D0100", Address("D", 100), "D100"),
        ("X17", Address("X", 15), "X17"),
        ("X0177", Address("X", 127), "X177"),
        ("y20", Address("Y", 16), "Y20"),
        ("C199", Address("C", 199), "C199"),
        ("C200", Address("C32", 200), "C200"),
        ("CN255", Address("C32", 255), "C255"),
        ("TN5", Address("T", 5), "T5"),
        ("T5", Address("T", 5), "T5"),
        ("TS5", Address("TS", 5), "TS5"),
        ("CS255", Address("CS", 255), "CS255"),
        ("M1535", Address("M", 1535), "M1535"),
        ("M8126", Address("M8", 8126), "M8126"),
        ("D8120", Address("D8", 8120), "D8120"),
        ("D7.3", Address("D", 7, 3), "D7.3"),
        ("S999", Address("S", 999), "S999"),
    ],
)
def test_devices_are_written_as_their_maker_writes_them(
    text: str, address: Address, spelled: str
) -> None:
    driver = ComputerLink()
    assert driver.address(text) == address
    assert driver.spell(address) == spelled


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("TC5", "coils cannot be reached.*TS5.*T5"),
        ("cc200", "coils cannot be reached.*CS200.*C200"),
        ("X8", "octal"),
        ("X200", "X0 to X177"),
        ("M1536", "M0 to M1535 and M8000 to M8255"),
        ("D4000", "D0 to D3999 and D8000 to D8255"),
        ("C256", "C0 to C255"),
        ("S1000", "S999"),
        ("Z1", "no device Z"),
        ("M5.1", "bit already"),
        ("", "no device address"),
    ],
)
def test_an_address_the_plc_does_not_have_gets_a_correct_example(text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        ComputerLink().address(text)


@pytest.mark.parametrize(
    ("profile", "has", "has_not"),
    [
        ("ex1s", ["X17", "Y17", "M1535", "D3999"], ["X20", "Y20"]),
        ("ex1n", ["X177"], ["X200", "M1536"]),
        ("ex2n", ["Y177"], ["Y200", "D4000"]),
        ("fx", ["X267", "M3071", "D7999"], ["X270", "M3072", "D8000.16", "D8256"]),
    ],
)
def test_1_5_each_profile_has_its_ranges(
    profile: ProfileName, has: list[str], has_not: list[str]
) -> None:
    driver = ComputerLink(profile=profile)
    for text in has:
        assert driver.spell(driver.address(text)) == text
    for text in has_not:
        with pytest.raises(ConfigError):
            driver.address(text)


DOCS = Path(__file__).parents[2] / "docs"
DOCUMENT = (DOCS / "computer-link.md").read_text()
REFERENCE = (DOCS / "computer-link-reference.md").read_text()


@pytest.mark.parametrize("snippet", re.findall(r"```yaml\n(.*?)```", DOCUMENT, re.DOTALL))
def test_the_files_in_the_document_are_valid(snippet: str, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(snippet)
    devices = load(file).lines[0].devices
    assert all(isinstance(device.driver, ComputerLink) for device in devices)


def test_the_frames_in_the_document_are_those_of_the_vectors() -> None:
    rows = re.findall(r"^((?:[0-9A-F]{2} +){10,})(?:ENQ|STX)", REFERENCE, re.MULTILINE)
    assert [bytes.fromhex(row) for row in rows] == [vector("001"), vector("057")]
