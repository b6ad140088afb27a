"""The simulated Computer Link PLC: the manual's commands, and the refusals in their order."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import Refused
from gateway.protocols.computer_link import ComputerLink, Enquiry, Frame, LinkCodec, Nak, Text
from gateway.protocols.computer_link.devices import ProfileName
from gateway.protocols.driver import Span
from gateway.stations.computer_link import ComputerLinkStation
from gateway.stations.station import Station
from tests.doubles import Wire
from tests.protocols.computer_link_peer import PROCEDURES, FrameFormat, Peer, Procedure
from tests.vectors import Vector, vectors

LINK = vectors("fxlink")
VECTORS = {vector.id: vector.frame for vector in LINK}
REQUESTS = [vector for vector in LINK if vector.valid and "command" in vector.fields]


def station_of(vector: Vector) -> ComputerLinkStation:
    number = vector.fields["station"]
    return ComputerLinkStation(
        5 if number == 0xFF else number,
        "liyan",
        vector.fields["format"],
        vector.fields["sum_check"],
    )


def answer(station: ComputerLinkStation, text: str, now: float = 0.0) -> list[Frame]:
    """Returns the reply of the station to a request; the text is from station to area."""
    peer = Peer(station.station, station.frame_format, station.sum_check)
    reader = LinkCodec(station.frame_format, station.sum_check)
    return [frame for block in station.hear(peer.enq(text), now) for frame in reader.feed(block)]


def code(station: ComputerLinkStation, text: str) -> str:
    match answer(station, text):
        case [Nak(_, code_)]:
            return code_
        case [_]:
            return ""
    return "silent"


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_every_request_of_the_vectors_is_carried_out(vector: Vector) -> None:
    station = station_of(vector)
    command = vector.fields["command"]
    if command in ("MB", "MN"):
        peer = Peer(station.station, station.frame_format, station.sum_check)
        for registered in ("08FFBM001M0000", "08FFWM001D0000"):
            station.hear(peer.enq(registered), 0.0)
    if command == "RR":
        answer(station, "1FFFRS0")
    heard = station.hear(vector.frame, 0.0)
    if command == "GW":
        assert heard == []
        assert station.memory.read("M8", 8126) == [int(vector.fields["area"])]
        return
    assert len(heard) == 1
    assert heard[0][:1] == (b"\x02" if command in ("BR", "WR", "MB", "MN", "TT") else b"\x06")
    assert station.delay == pytest.approx(vector.fields["wait"] / 100)


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_a_request_in_pieces_is_the_same_request(vector: Vector) -> None:
    whole, pieces = station_of(vector), station_of(vector)
    expected = whole.hear(b"\x00\x02" + vector.frame, 0.0)
    heard = [block for byte in vector.frame for block in pieces.hear(bytes([byte]), 0.0)]
    assert heard == expected


@pytest.mark.parametrize(
    ("number", "codes"), [("164", ["02"]), ("165", ["06", "03"]), ("166", ["07"])]
)
def test_negative_vectors_are_refused(number: str, codes: list[str]) -> None:
    for station in (ComputerLinkStation(5), ComputerLinkStation(0)):
        for block in station.hear(VECTORS[f"fxlink-{number}"], 0.0):
            assert block[:1] == b"\x15"
            assert block[5:].decode() in codes
            return
    pytest.fail("no answer")


@pytest.mark.parametrize(
    ("number", "area", "start", "units"),
    [
        ("057", "M", 10, [0, 1, 1, 0, 1]),
        ("059", "M", 10, [0, 1, 1, 0, 1]),
        ("076", "M", 10, [0, 1, 1, 0, 1]),
    ],
)
def test_2_1_m10_to_m14_are_answered_as_in_the_vector(
    number: str, area: str, start: int, units: list[int]
) -> None:
    vector = next(v for v in LINK if v.id == f"fxlink-{number}")
    station = station_of(vector)
    station.memory.write(area, start, units)
    peer = Peer(5, vector.fields["format"], vector.fields["sum_check"])
    assert station.hear(peer.enq("05FFBRAM001005"), 0.0) == [vector.frame]
    assert station.delay == pytest.approx(0.1)


@pytest.mark.parametrize(("number", "frame_format"), [("063", 1), ("080", 4)])
def test_c200_is_answered_as_in_the_vector(number: str, frame_format: FrameFormat) -> None:
    station = ComputerLinkStation(0, frame_format=frame_format)
    station.memory.write("C32", 200, [0x12345678])
    block = Peer(0, frame_format, True).enq("00FFWR0CN20001")
    assert station.hear(block, 0.0) == [VECTORS[f"fxlink-{number}"]]


@pytest.mark.parametrize(
    ("number", "frame_format", "sum_check"), [("058", 1, True), ("060", 1, False), ("075", 4, True)]
)
def test_2_10_registered_words_are_answered_as_in_the_vector(
    number: str, frame_format: FrameFormat, sum_check: bool
) -> None:
    station = ComputerLinkStation(8, "liyan", frame_format, sum_check)
    station.memory.write("D", 500, [0x1234])
    station.memory.write("C", 100, [0x64])
    station.memory.write("Y", 0o100, [int(bit) for bit in reversed(f"{0xBCA9:016b}")])
    answer(station, "08FFWM003D0500CN100Y0100")
    peer = Peer(8, frame_format, sum_check)
    for command in ("MN", "MW"):
        expected = [VECTORS[f"fxlink-{number}"]]
        assert station.hear(peer.enq(f"08FF{command}0"), 0.0) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("05FFZZ0", "03"),
        ("05FFZZ0M001005", "03"),
        ("05FFBR0M001000", "06"),
        ("05FFBR0M001041", "06"),  # 65 points
        ("05FFBR0M0010zz", "06"),
        ("05FFBR0M153501", ""),
        ("05FFBR0M153502", "06"),
        ("05FFBR0M153601", "06"),
        ("05FFBR0X000801", "06"),
        ("05FFBR0X017701", ""),
        ("05FFBR0X020001", "06"),
        ("05FFBR0D000001", "06"),
        ("05FFBR0TC00001", "06"),
        ("05FFBR0TN00001", "06"),
        ("05FFBRzM001001", "06"),
        ("05FFWR0M001001", "06"),  # no multiple of 8
        ("05FFWR0M000840", ""),
        ("05FFWR0M000841", "06"),  # 65 words
        ("05FFWR0TS00001", "06"),
        ("05FFWR0CN20010", ""),
        ("05FFWR0CN20011", "06"),
        ("05FFWR0CN19902", "06"),
        ("05FFWR0D399901", ""),
        ("05FFWR0D399902", "06"),
        ("05FFWR0D000041", "06"),
        ("05FFBW0M00010112", None),
        ("05FFBW0M0001012", "07"),
        ("05FFWW0D00000112G4", "07"),
        ("05FFWW0M0000090000" + "0000" * 8, "06"),
        ("05FFBT000", "06"),
        ("05FFBT002M00011M0002x", "07"),
        ("05FFBT001D00011", "06"),
        ("05FFBT015" + "M00011" * 21, "06"),
        ("05FFWT001CN2000001", "06"),
        ("05FFWT001M00010001", "06"),
        ("05FFWT00B" + "D00010001" * 11, "06"),
        ("05FFBM00B" + "M0001" * 11, "06"),
        ("05FFWM001CN200", "06"),
        ("05FFMB0", "06"),
        ("05FFMN0", "06"),
        ("05FFTT000", "06"),
        ("05FFTT081" + "A" * 129, "06"),
        ("05FFTT080" + "A" * 128, ""),
        ("05FFPC0", ""),
        ("0500PC0", "10"),
        ("0500WW0D00000112G4", "07"),
        ("0500BR0M999901", "06"),
        ("0500ZZ0M999901", "03"),
        ("05FFRR0", "18"),
        ("0500RR0", "10"),
    ],
)
@pytest.mark.parametrize("procedure", PROCEDURES)
def test_the_lowest_error_code_that_applies_is_sent(
    text: str, expected: str | None, procedure: Procedure
) -> None:
    if expected is None:  # a character too many: only format 4 can tell
        expected = "06" if procedure[0] == 4 else ("02" if procedure[1] else "")
    assert code(ComputerLinkStation(5, "liyan", *procedure), text) == expected


def test_a_wrong_sum_is_reported_before_every_other_error() -> None:
    station = ComputerLinkStation(5)
    block = Peer(5, 1, True).enq("0500BR0M999901")
    assert station.hear(block[:-1] + b"x", 0.0) == [Peer(5, 1, True).nak("02")]


def test_fx_takes_256_points_as_00_and_has_no_monitor() -> None:
    station = ComputerLinkStation(5, "fx")
    [frame] = answer(station, "05FFBR0M000000")
    assert frame == Text(5, "0" * 256)
    assert code(station, "05FFBM001M0000") == "06"
    assert code(ComputerLinkStation(5, "ex1s"), "05FFBR0X002001") == "06"


@pytest.mark.parametrize("procedure", PROCEDURES)
def test_a_hole_is_refused_with_06_and_only_where_it_is(procedure: Procedure) -> None:
    station = ComputerLinkStation(5, "liyan", *procedure, holes=[("D", 12), ("M", 20)])
    assert code(station, "05FFWR0D001003") == "06"
    assert code(station, "05FFWR0D001002") == ""
    assert code(station, "05FFWR0M001601") == "06"
    assert code(station, "05FFBR0M001604") == ""
    assert code(station, "05FFWT001D00120001") == "06"


def test_a_refused_write_writes_nothing() -> None:
    station = ComputerLinkStation(5, holes=[("D", 12)])
    assert code(station, "05FFWT002D00110007D00120007") == "06"
    assert code(station, "05FFBT002M00011M0002x") == "07"
    assert station.memory.read("D", 11) == [0]
    assert station.memory.read("M", 1) == [0]


def test_requests_to_other_stations_and_all_replies_are_ignored() -> None:
    station, peer = ComputerLinkStation(5), Peer(6, 1, True)
    for block in (peer.enq("06FFPC0"), peer.stx("0001"), peer.ack(), peer.nak("06")):
        assert station.hear(block, 0.0) == []
    assert code(station, "05FFPC0") == ""


def test_2_8_a_command_to_station_ff_is_not_answered() -> None:
    station = ComputerLinkStation(5)
    assert answer(station, "FFFFPC0") == []
    assert station.memory.read("D8", 8063) == [6305]
    assert station.memory.read("M8", 8063) == [1]


def test_an_incomplete_message_is_dropped_after_d8129_and_not_answered() -> None:
    station = ComputerLinkStation(5)
    block = Peer(5, 1, True).enq("05FFPC0")
    assert station.hear(block[:-1], 10.0) == []
    assert station.hear(block[-1:], 10.2) == []
    assert station.memory.read("D8", 8063) == [6306]
    station.memory.write("D8", 8129, [30])
    assert station.hear(block[:-1], 20.0) == []
    assert len(station.hear(block[-1:], 20.2)) == 1


def test_an_endless_message_is_dropped() -> None:
    station = ComputerLinkStation(5, frame_format=4)
    station.hear(b"\x0505FF" + b"0" * 700, 0.0)
    assert station.hear(b"\r\n", 0.0) == []
    assert station.memory.read("D8", 8063) == [6306]


@pytest.mark.parametrize("procedure", PROCEDURES)
def test_2_13_a_loopback_of_unprintable_characters_is_refused(procedure: Procedure) -> None:
    station = ComputerLinkStation(5, "liyan", *procedure)
    for byte in (0x00, 0x7F, 0x80, 0xFF):
        body = b"05FFTT001" + bytes([byte])
        check = b"%02X" % (sum(body) % 256) if procedure[1] else b""
        block = b"\x05" + body + check + (b"\r\n" if procedure[0] == 4 else b"")
        assert station.hear(block, 0.0) == [Peer(5, *procedure).nak("07")]


@pytest.mark.parametrize("number", ["091", "064", "066"])
def test_eot_ack_and_nak_of_the_computer_reset_the_sequence(number: str) -> None:
    station, block = ComputerLinkStation(5), Peer(5, 1, True).enq("05FFPC0")
    assert station.hear(block[:5] + VECTORS[f"fxlink-{number}"] + block[5:], 0.0) == []
    assert len(station.hear(block[:5] + VECTORS[f"fxlink-{number}"] + block, 0.0)) == 1


def test_area_c_is_swallowed() -> None:
    station = ComputerLinkStation(31, frame_format=4)
    assert station.hear(VECTORS["fxlink-082"], 0.0) == []


def test_2_11_remote_run_and_stop_move_m8035_to_m8037() -> None:
    station = ComputerLinkStation(5)
    flags = lambda: station.memory.read("M8", 8035, 3)  # noqa: E731  # read afresh each time
    assert station.link.running
    assert code(station, "05FFRR0") == "18"
    assert code(station, "05FFGW01") == "silent"
    assert code(station, "05FFRS0") == ""
    assert not station.link.running
    assert flags() == [0, 0, 1]
    assert station.memory.read("M8", 8126) == [0]
    assert code(station, "05FFRS0") == "18"
    assert code(station, "05FFRR0") == ""
    assert station.link.running
    assert flags() == [1, 1, 0]
    station.power_cycle()
    assert not station.link.running
    station.link.switch_at_run = True
    assert code(station, "05FFRR0") == "18"
    assert code(station, "05FFRS0") == "18"


def test_2_12_the_global_flag_of_one_station_or_of_all_is_never_answered() -> None:
    station = ComputerLinkStation(5)
    for text, flag in (("FFFFGW01", 1), ("05FFGW00", 0), ("05FFGW01", 1), ("06FFGW00", 1)):
        assert answer(station, text) == []
        assert station.memory.read("M8", 8126) == [flag]
    station.power_cycle()
    assert station.memory.read("M8", 8126) == [0]


@pytest.mark.parametrize(
    ("procedure", "d8120"),
    [((1, True), 0x6086), ((4, True), 0xE086), ((1, False), 0x4086), ((4, False), 0xC086)],
)
def test_d8120_and_d8121_are_taken_at_power_on_only(procedure: Procedure, d8120: int) -> None:
    assert ComputerLinkStation(5, "liyan", *procedure).memory.read("D8", 8120, 2) == [d8120, 5]
    station = ComputerLinkStation(5)
    station.memory.write("D8", 8120, [d8120, 7])
    assert code(station, "05FFPC0") == ""
    station.power_cycle()
    assert (station.station, station.frame_format, station.sum_check) == (7, *procedure)
    assert code(station, "07FFPC0") == ""
    station.memory.write("D8", 8120, [d8120 & ~0x4000])
    station.power_cycle()
    assert code(station, "07FFPC0") == "silent"


def test_the_registered_lists_are_lost_at_power_off() -> None:
    station = ComputerLinkStation(5)
    for forget in (station.link.forget_monitor, station.power_cycle):
        assert code(station, "05FFBM001M0000") == ""
        assert code(station, "05FFMB0") == ""
        assert code(station, "05FFMN0") == "06"
        forget()
        assert code(station, "05FFMB0") == "06"


def test_a_mute_station_carries_out_a_request_and_its_reply_is_lost() -> None:
    station = ComputerLinkStation(5)
    station.mute = True
    assert code(station, "05FFBW0M0001011") == "silent"
    assert station.memory.read("M", 1) == [1]


def test_the_reply_to_pc_is_the_model_code() -> None:
    assert answer(ComputerLinkStation(5, model="F3"), "05FFPC0") == [Text(5, "F3")]


@pytest.mark.parametrize("procedure", PROCEDURES)
def test_on_demand_data_carries_pc_number_fe(procedure: Procedure) -> None:
    block = ComputerLinkStation(5, "liyan", *procedure).on_demand("1234")
    assert LinkCodec(*procedure).feed(block) == [Text(5, "1234", "FE")]


@pytest.mark.parametrize("procedure", PROCEDURES)
async def test_the_driver_and_the_station_agree(procedure: Procedure) -> None:
    station = ComputerLinkStation(5, "liyan", *procedure, holes=[("D", 50)])
    driver = ComputerLink(
        station=5, frame_format=procedure[0], sum_check=procedure[1], monitor=True
    )
    assert {(a.name, a.first, a.last) for a in driver.areas.values()} == {
        (name, first, last)
        for name, first, last in ((a.name, a.first, a.last) for a in driver.areas.values())
        if station.memory.holds(name, first, last - first + 1)
        and not station.memory.holds(name, first, last - first + 2)
    }
    wire = Wire(driver, lambda data: station.hear(data, 0.0))
    for area in driver.areas.values():
        span = Span(area.name, area.last - 15, 16)
        units = [i % 2 for i in range(16)]
        await driver.write(wire, span, units)
        assert station.memory.read(*span) == units
        assert list(await driver.read(wire, span)) == units
    await driver.register(wire, [Span("M", 1535, 1), Span("D", 3999, 1)])
    assert await driver.read_registered(wire, [Span("M", 1535, 1), Span("D", 3999, 1)]) == [
        [1],
        [1],
    ]
    with pytest.raises(Refused, match="06"):
        await driver.read(wire, Span("D", 40, 20))
    await driver.resync(wire, None, 1)


def test_it_is_a_station() -> None:
    station: Station = ComputerLinkStation(5)
    station.memory.animate("D", 7, lambda now: int(now) - 1)
    assert answer(ComputerLinkStation(5), "05FFWR0D000701") == [Text(5, "0000")]
    blocks = station.hear(Peer(5, 1, True).enq("05FFWR0D000701"), 0.0)
    assert blocks == [Peer(5, 1, True).stx("FFFF")]


pieces_of_line = st.lists(
    st.one_of(
        st.binary(max_size=6),
        st.sampled_from(
            [
                b"\x05",
                b"05FF",
                b"\r\n",
                b"BR0M001001",
                b"BW0",
                b"WT0",
                b"TT0",
                b"\x0505FFTT001",
                b"\x0505FFBW0M000001",
                b"FF",
                b"\x05FFFFGW01",
            ]
        ),
    ),
    max_size=12,
)


@settings(max_examples=150)
@given(pieces_of_line, st.sampled_from(PROCEDURES), st.sampled_from(["liyan", "fx"]))
def test_after_any_bytes_the_next_request_gets_its_reply(
    pieces: list[bytes], procedure: Procedure, profile: ProfileName
) -> None:
    station = ComputerLinkStation(5, profile, *procedure)
    for piece in pieces:
        for block in station.hear(piece, 0.0):
            assert block[:1] in (b"\x02", b"\x06", b"\x15")
    assert code(station, "05FFTT005ABCDE") == ""


def test_requests_made_by_the_codec_are_those_of_the_manual() -> None:
    block = LinkCodec(1, True).encode(Enquiry(5, "PC"))
    assert block == Peer(5, 1, True).enq("05FFPC0")
