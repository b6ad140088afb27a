"""The simulated Vigor PLC, against the worked examples and the address map of the manual."""

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateway.protocols.vigor import Reply, Request
from gateway.protocols.vigor.codec import encode
from gateway.stations.vigor import VigorStation
from tests.vectors import Vector, vectors

VECTORS = {vector.id: vector for vector in vectors("vigor")}
REQUESTS = [v for v in VECTORS.values() if v.direction == "request" and v.valid]
OF_STATION_0 = [v for v in REQUESTS if v.fields["station"] == 0]
NEGATIVES = [v for v in VECTORS.values() if not v.valid]


def ask(station: VigorStation, command: str, body: bytes, number: int = 0) -> list[bytes]:
    return station.hear(encode(Request(number, command, body)), 0.0)


def status(code: str, command: str = "51", number: int = 0) -> list[bytes]:
    return [encode(Reply(number, command, code))]


# ---- the worked examples, bytes in, bytes out --------------------------------------------


def bits(text: str) -> list[int]:
    """Bits as the manual draws them, the highest device first."""
    return [int(bit) for bit in reversed(text)]


@pytest.mark.parametrize(
    ("request_id", "reply_id", "area", "start", "units"),
    [
        ("vigor-001", "vigor-002", "M", 8, bits("1001001110100111")),
        ("vigor-003", "vigor-004", "D", 1, [0x1234, 0xABCD]),
        ("vigor-014", "vigor-015", "M", 8, bits("11010001")),
        ("vigor-042", "vigor-050", "C32", 200, [0x12345678]),
        ("vigor-042", "vigor-051", "C32", 200, [0xFFFFFFFE]),
        ("vigor-037", "vigor-053", "T", 255, [32769]),
    ],
)
def test_b5_3_51h_reads_as_the_examples_print_it(
    request_id: str, reply_id: str, area: str, start: int, units: list[int]
) -> None:
    station = VigorStation(VECTORS[reply_id].fields["station"])
    station.memory.write(area, start, units)
    assert station.hear(VECTORS[request_id].frame, 0.0) == [VECTORS[reply_id].frame]


@pytest.mark.parametrize(
    ("request_id", "reply_id", "area", "start", "before", "after"),
    [
        ("vigor-005", "vigor-006", "Y", 0o30, 0, bits("0011111011000110")),
        ("vigor-016", "vigor-006", "Y", 0o30, 0, bits("10110001")),
        ("vigor-007", "vigor-006", "D", 1, 0, [0xA325]),
        ("vigor-008", "vigor-009", "M", 10, 0, [1]),
        ("vigor-010", "vigor-011", "M", 100, 1, [0]),
        ("vigor-017", "vigor-009", "M", 20, 0, [1]),
        ("vigor-076", "vigor-009", "S", 20, 0, [1]),
    ],
)
def test_b5_3_61h_70h_71h_write_as_the_examples_print_it(
    request_id: str, reply_id: str, area: str, start: int, before: int, after: list[int]
) -> None:
    station = VigorStation(0)
    neighbours = start - 1, start + len(after)
    station.memory.write(area, start - 1, [before] * (len(after) + 2))
    assert station.hear(VECTORS[request_id].frame, 0.0) == [VECTORS[reply_id].frame]
    assert station.memory.read(area, start, len(after)) == after
    assert [station.memory.read(area, number) for number in neighbours] == [[before], [before]]


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_every_good_request_is_done(vector: Vector) -> None:
    fields: dict[str, Any] = vector.fields
    number, command = fields["station"], fields["command"]
    data = bytes(fields["length"]) if command == "51" else b""
    station = VigorStation(number)
    assert station.hear(vector.frame, 0.0) == [encode(Reply(number, command, "00", data))]


@pytest.mark.parametrize("vector", NEGATIVES, ids=repr)
def test_every_bad_request_is_answered_with_its_status(vector: Vector) -> None:
    expected = vector.fields["expect"].split()[2]
    assert vector.fields["expect"].startswith("reply status")
    assert VigorStation(0).hear(vector.frame, 0.0) == status(expected)


# ---- which status ------------------------------------------------------------------------


def test_another_station_is_left_alone() -> None:
    station = VigorStation(1)
    assert station.hear(VECTORS["vigor-003"].frame, 0.0) == []
    assert len(station.hear(VECTORS["vigor-012"].frame, 0.0)) == 1


def test_a_bad_character_counts_before_a_bad_sum() -> None:
    frame = VECTORS["vigor-088"].frame
    assert VigorStation(0).hear(frame[:-1] + b"9", 0.0) == status("10")


def test_a_sum_that_is_no_hex_is_status_10() -> None:
    frame = VECTORS["vigor-001"].frame
    assert VigorStation(0).hear(frame[:-2] + b"f4", 0.0) == status("10")


def test_a_bad_sum_counts_before_an_unknown_command() -> None:
    frame = encode(Request(0, "99", b""))
    assert VigorStation(0).hear(frame[:-2] + b"00", 0.0) == status("11", "99")


def test_an_unknown_command_is_status_12() -> None:
    assert ask(VigorStation(0), "99", b"") == [VECTORS["vigor-079"].frame]


@pytest.mark.parametrize(
    ("command", "body", "code"),
    [
        ("51", b"1C000", "10"),  # half a count
        ("51", b"1C0002AA", "10"),  # a read that brings data
        ("51", b"1C0000AA", "28"),  # the count is looked at first
        ("61", b"1C000212", "10"),  # less data than counted
        ("61", b"1C0002123456", "10"),
        ("61", b"1C0002123", "10"),
        ("61", b"5C0002", "28"),  # the range is looked at first
        ("70", b"040", "10"),
        ("70", b"040A0", "10"),
    ],
)
def test_a_body_of_another_length_is_status_10(command: str, body: bytes, code: str) -> None:
    assert ask(VigorStation(0), command, body) == status(code, command)


HOLES = [
    (0x037D, 0x037F),
    (0x03C0, 0x03DF),
    (0x0400, 0x077F),
    (0x07C0, 0x13FF),
    (0x1990, 0x19FF),
    (0x1AE0, 0x1BFF),
    (0x5C00, 0xFFFF),
]


@pytest.mark.parametrize("hole", HOLES, ids=lambda hole: f"{hole[0]:04X}-{hole[1]:04X}")
def test_b5_3_an_address_outside_the_map_is_status_28(hole: tuple[int, int]) -> None:
    station = VigorStation(0)
    first, last = hole
    for byte in (first, last):
        assert ask(station, "51", b"%04X01" % byte) == status("28")
        assert ask(station, "61", b"%04X01FF" % byte) == status("28", "61")
    assert ask(station, "51", b"%04X02" % (first - 1)) == status("28")
    assert ask(station, "51", b"%04X01" % (first - 1)) != status("28")
    if last < 0xFFFF:
        assert ask(station, "51", b"%04X02" % last) == status("28")
        assert ask(station, "51", b"%04X01" % (last + 1)) != status("28")


@pytest.mark.parametrize("count", [0x00, 0x81, 0xFF])
def test_more_than_128_bytes_or_none_are_status_28(count: int) -> None:
    assert ask(VigorStation(0), "51", b"1C00%02X" % count) == status("28")


def test_a_refused_write_changes_nothing() -> None:
    station = VigorStation(0)
    assert ask(station, "61", b"5BFE03FFFFFF") == status("28", "61")
    assert station.memory.read("D", 8191) == [0]


@pytest.mark.parametrize("byte", [0x0380, 0x03A0, 0x0780, 0x07A0, 0x037D, 0x1C00])
def test_70h_and_71h_take_no_bits_of_timers_counters_or_registers(byte: int) -> None:
    assert ask(VigorStation(0), "70", b"%04X" % (byte * 8)) == status("28", "70")


def test_a_device_the_model_lacks_is_status_28() -> None:
    station = VigorStation(0, holes={("D", 2), ("M", 10)})
    assert station.hear(VECTORS["vigor-003"].frame, 0.0) == [VECTORS["vigor-081"].frame]
    assert station.hear(VECTORS["vigor-001"].frame, 0.0) == [VECTORS["vigor-081"].frame]
    assert station.hear(VECTORS["vigor-008"].frame, 0.0) == [VECTORS["vigor-085"].frame]
    station.memory.holes.clear()
    assert station.hear(VECTORS["vigor-008"].frame, 0.0) == [VECTORS["vigor-009"].frame]


# ---- hearing -----------------------------------------------------------------------------


def test_a_new_stx_begins_another_request() -> None:
    frame = VECTORS["vigor-001"].frame
    for cut in range(1, len(frame)):
        assert len(VigorStation(0).hear(frame[:cut] + frame, 0.0)) == 1


def test_a_request_without_a_command_gets_no_reply() -> None:
    assert VigorStation(0).hear(b"\x0200\x0363", 0.0) == []
    assert VigorStation(0).hear(b"\x02005\x0398", 0.0) == []


def test_an_endless_request_is_dropped() -> None:
    station = VigorStation(0)
    assert station.hear(b"\x02" + b"0" * 5000, 0.0) == []
    assert station.hear(b"\x03" + b"00", 0.0) == []
    assert len(station.hear(VECTORS["vigor-065"].frame, 0.0)) == 1


@given(st.lists(st.sampled_from(OF_STATION_0), min_size=1, max_size=4), st.data())
def test_requests_are_found_in_any_pieces(asked: list[Vector], data: st.DataObject) -> None:
    stream = b"".join(vector.frame for vector in asked)
    whole = VigorStation(0).hear(stream, 0.0)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)))))
    station, replies = VigorStation(0), []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        replies += station.hear(stream[begin:end], 0.0)
    assert replies == whole
    assert len(whole) == len(asked)


@given(st.binary(max_size=80))
@example(b"\x0200\xe9\xff\x0300")
@example(b"\x0200\x06\x06\x0300")
@example(b"\x02\x03\x03\x03")
@example(b"\x02 151\x0300")
def test_any_bytes_are_answered_or_ignored(data: bytes) -> None:
    for reply in VigorStation(0).hear(data, 0.0):
        assert reply[:3] == b"\x0600"


def test_the_reply_is_upper_case_for_any_request() -> None:
    frame = encode(Request(0x0A, "51", b"1C0002"))
    heard = VigorStation(0x0A).hear(frame.replace(b"0A51", b"0a51"), 0.0)
    assert heard == status("10", number=0x0A)


def test_a_mute_station_carries_out_a_request_but_its_reply_is_lost() -> None:
    station = VigorStation(0)
    station.mute = True
    assert station.hear(VECTORS["vigor-007"].frame, 0.0) == []
    assert station.memory.read("D", 1) == [0xA325]


def test_a_moving_register_is_read_as_it_is_now() -> None:
    station = VigorStation(0)
    station.memory.animate("D", 1, int)
    station.memory.write("D", 2, [0xABCD])
    assert station.hear(VECTORS["vigor-003"].frame, 0x1234) == [VECTORS["vigor-004"].frame]


def test_half_a_register_can_be_written() -> None:
    station = VigorStation(0)
    station.memory.write("D", 1, [0x1234])
    station.memory.write("C32", 200, [0x12345678])
    assert ask(station, "61", b"1C0301AB") == status("00", "61")
    assert ask(station, "61", b"1A0201AB") == status("00", "61")
    assert station.memory.read("D", 1) == [0xAB34]
    assert station.memory.read("C32", 200) == [0x12AB5678]


def test_one_request_may_run_from_one_area_into_the_next() -> None:
    station = VigorStation(0)
    station.memory.write("X", 0o770, [1])
    station.memory.write("Y", 0o7, [1])
    assert ask(station, "51", b"003F02") == [encode(Reply(0, "51", "00", b"\x01\x80"))]


@pytest.mark.parametrize("number", [-1, 256])
def test_station_numbers_end_at_255(number: int) -> None:
    with pytest.raises(ValueError, match=r"is not 0\.\.255"):
        VigorStation(number)
