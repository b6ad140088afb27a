"""The Vigor computer link, against the worked examples of its manual (B-5) and protocol note."""

from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import (
    BadValue,
    ConfigError,
    DeviceError,
    Evidence,
    Garbled,
    NoReply,
    Refusal,
    Refused,
)
from gateway.protocols.driver import Address, Cost, Driver, Span, Unit
from gateway.protocols.vigor import Frame, Reply, Request, Vigor, VigorCodec
from gateway.protocols.vigor.codec import encode
from gateway.stations.vigor import VigorStation
from tests.doubles import Script, Wire
from tests.vectors import Vector, vectors

T = TypeVar("T")
VECTORS = {vector.id: vector for vector in vectors("vigor")}
REQUESTS = [v for v in VECTORS.values() if v.direction == "request" and v.valid]
RESPONSES = [v for v in VECTORS.values() if v.direction == "response"]
UNIT_BITS = {Unit.BIT: 1, Unit.WORD: 16, Unit.DWORD: 32}
AREAS = Vigor().areas


def sent(name: str) -> str:
    return "> " + VECTORS[name].frame.hex(" ")


def heard(name: str) -> str:
    return "< " + VECTORS[name].frame.hex(" ")


def play(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a driver, which waits for nothing but the talk, to its end."""
    try:
        coroutine.send(None)
    except StopIteration as stop:
        value: T = stop.value
        return value
    raise AssertionError("the driver waited for something else than its talk")


def bus(hear: Callable[[bytes], list[bytes]]) -> Wire:
    return Wire(Vigor(), hear, bounded=True)


# ---- every frame of the vectors ----------------------------------------------------------


def device_of(fields: dict[str, Any]) -> Address:
    """The device a vector names: `T248..T255 coil`, `C0 current value`, `X0`."""
    name, _, face = fields["device"].partition(" ")
    first = name.partition("..")[0]
    letters = {"contact": "S", "coil": "C"}.get(face, "")
    return Vigor().address(first[0] + letters + first[1:])


def units_of(data: bytes, unit: Unit) -> list[int]:
    width = UNIT_BITS[unit]
    number = int.from_bytes(data, "little")
    return [number >> at & (1 << width) - 1 for at in range(0, 8 * len(data), width)]


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
async def test_the_driver_sends_exactly_the_vector(vector: Vector) -> None:
    fields = vector.fields
    driver, command = Vigor(station=fields["station"]), fields["command"]
    area, number, _ = device_of(fields)
    unit = AREAS[area].unit
    data = bytes.fromhex(fields.get("data", "")) or bytes(fields.get("length", 0))
    good = encode(Reply(fields["station"], command, "00", data if command == "51" else b""))
    script = Script(driver, f"> {vector.frame.hex(' ')}", f"< {good.hex(' ')}")
    if command in ("70", "71"):
        assert await driver.write(script, Span(area, number, 1), [int(command == "70")])
    else:
        units = units_of(data, unit)
        span = Span(area, number, len(units))
        if command == "51":
            assert list(await driver.read(script, span)) == units
            assert driver.cost(span) == Cost(len(vector.frame), len(good))
        else:
            assert await driver.write(script, span, units) is True
            assert driver.write_cost(span) == Cost(len(vector.frame), len(good))
    script.done()
    assert script.replies == [len(good)]


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_a_request_of_the_vectors_is_encoded_from_its_fields(vector: Vector) -> None:
    fields = vector.fields
    body: str = fields.get("start_byte_address") or fields["bit_address"]
    body += f"{fields['length']:02X}{fields.get('data', '')}" if "length" in fields else ""
    frame = Request(fields["station"], fields["command"], body.encode())
    assert VigorCodec().encode(frame) == vector.frame


@pytest.mark.parametrize("vector", RESPONSES, ids=repr)
def test_a_response_of_the_vectors_is_decoded_to_its_fields(vector: Vector) -> None:
    fields = vector.fields
    reply = Reply(
        fields["station"],
        fields["command"],
        fields["status"],
        bytes.fromhex(fields.get("data", "")),
    )
    assert VigorCodec().feed(vector.frame) == [reply]
    assert VigorCodec().encode(reply) == vector.frame


# ---- the worked examples of the manual ---------------------------------------------------


def bits(text: str) -> list[int]:
    """Bits as the manual draws them, the highest device first."""
    return [int(bit) for bit in reversed(text)]


async def test_b5_3_51h_example_1_reads_m8_to_m23() -> None:
    script = Script(Vigor(), sent("vigor-001"), heard("vigor-002"))
    read = await Vigor().read(script, Span("M", 8, 16))
    assert read == bits("1001001110100111")


async def test_b5_3_51h_example_2_reads_d1_and_d2() -> None:
    script = Script(Vigor(), sent("vigor-003"), heard("vigor-004"))
    assert list(await Vigor().read(script, Span("D", 1, 2))) == [0x1234, 0xABCD]


async def test_b5_3_61h_example_1_writes_y30_to_y47() -> None:
    script = Script(Vigor(), sent("vigor-005"), heard("vigor-006"))
    area, number, _ = Vigor().address("Y30")
    assert await Vigor().write(script, Span(area, number, 16), bits("0011111011000110"))


async def test_b5_3_61h_example_2_writes_a325h_into_d1() -> None:
    script = Script(Vigor(), sent("vigor-007"), heard("vigor-006"))
    assert await Vigor().write(script, Span("D", 1, 1), [0xA325])


async def test_b5_3_70h_example_1_sets_m10_to_on() -> None:
    script = Script(Vigor(), sent("vigor-008"), heard("vigor-009"))
    assert await Vigor().write(script, Span("M", 10, 1), [1])


async def test_b5_3_71h_example_2_sets_m100_to_off() -> None:
    script = Script(Vigor(), sent("vigor-010"), heard("vigor-011"))
    assert await Vigor().write(script, Span("M", 100, 1), [0])


async def test_b5_3_the_bit_address_of_s20_is_1814() -> None:
    script = Script(Vigor(), sent("vigor-076"), heard("vigor-009"))
    assert await Vigor().write(script, Span("S", 20, 1), [1])


def test_b5_2_the_check_code_of_1f4h_is_f4() -> None:
    frame = VECTORS["vigor-001"].frame
    assert sum(frame[1:-2]) == 0x1F4
    assert encode(Request(0, "51", b"008102"))[-2:] == frame[-2:] == b"F4"


async def test_b3_9_rs_example_reads_d0_of_station_1_with_check_code_00() -> None:
    assert VECTORS["vigor-012"].frame[-2:] == b"00"  # the sum is 200h
    good = encode(Reply(1, "51", "00", b"\x12\x34"))
    script = Script(Vigor(station=1), sent("vigor-012"), f"< {good.hex()}")
    assert list(await Vigor(station=1).read(script, Span("D", 0, 1))) == [0x3412]


async def test_b3_9_rs_example_gets_the_acknowledgement_of_d1_of_station_1() -> None:
    request = encode(Request(1, "61", b"1C02020001"))
    script = Script(Vigor(station=1), f"> {request.hex()}", heard("vigor-013"))
    assert await Vigor(station=1).write(script, Span("D", 1, 1), [0x0100])


async def test_protocol_note_reads_m8_to_m15() -> None:
    script = Script(Vigor(), sent("vigor-014"), heard("vigor-015"))
    assert await Vigor().read(script, Span("M", 8, 8)) == bits("11010001")


async def test_protocol_note_sets_y30_to_y37() -> None:
    script = Script(Vigor(), sent("vigor-016"), heard("vigor-006"))
    assert await Vigor().write(script, Span("Y", 0o30, 8), bits("10110001"))


async def test_protocol_note_writes_a325h_to_d1() -> None:
    script = Script(Vigor(), sent("vigor-007"), heard("vigor-006"))
    assert await Vigor().write(script, Span("D", 1, 1), [0xA325])


async def test_protocol_note_forces_m10_on() -> None:
    script = Script(Vigor(), sent("vigor-008"), heard("vigor-009"))
    assert await Vigor().write(script, Span("M", 10, 1), [1])


async def test_protocol_note_forces_m100_off() -> None:
    script = Script(Vigor(), sent("vigor-010"), heard("vigor-011"))
    assert await Vigor().write(script, Span("M", 100, 1), [0])


def test_protocol_note_appendix_a_the_check_sum_of_193h_is_93() -> None:
    frame = VECTORS["vigor-017"].frame
    assert sum(frame[1:-2]) == 0x193
    assert encode(Request(0, "70", b"0414"))[-2:] == frame[-2:] == b"93"


async def test_counters_from_c200_on_are_32_bits_low_byte_first() -> None:
    script = Script(Vigor(), sent("vigor-042"), heard("vigor-050"))
    assert list(await Vigor().read(script, Span("C32", 200, 1))) == [0x12345678]


# ---- addresses ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("X17", Address("X", 15)),
        ("Y777", Address("Y", 511)),
        ("M5119", Address("M", 5119)),
        ("M9003", Address("M9", 9003)),
        ("S999", Address("S", 999)),
        ("T5", Address("T", 5)),
        ("TN5", Address("T", 5)),
        ("TS5", Address("TS", 5)),
        ("TC5", Address("TC", 5)),
        ("C199", Address("C", 199)),
        ("C200", Address("C32", 200)),
        ("CN255", Address("C32", 255)),
        ("CS200", Address("CS", 200)),
        ("CC5", Address("CC", 5)),
        ("D0100", Address("D", 100)),
        ("D7.3", Address("D", 7, 3)),
        ("d9001", Address("D9", 9001)),
        ("D9001.15", Address("D9", 9001, 15)),
        ("T5.0", Address("T", 5, 0)),
    ],
)
def test_addresses_are_written_as_in_the_manual(text: str, address: Address) -> None:
    assert Vigor().address(text) == address
    assert Vigor().address(Vigor().spell(address)) == address


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("X18", "X18: X and Y are numbered in octal, 8 and 9 do not exist"),
        ("Y1000", "Y1000: Y goes from Y0 to Y777"),
        ("D9300", "D9300: D goes from D0 to D8191 and D9000 to D9255"),
        ("D8192", "D8192: D goes from D0 to D8191 and D9000 to D9255"),
        ("M5120", "M5120: M goes from M0 to M5119 and M9000 to M9255"),
        ("S1000", "S1000: S goes from S0 to S999"),
        ("TS256", "TS256: TS goes from TS0 to TS255"),
        ("C256", "C256: C goes from C0 to C255"),
        ("C200.31", "C200.31: C200 is 32 bits wide, only 16-bit words have bits"),
        ("Y20.1", "Y20.1: Y20 is a bit already, write Y20"),
    ],
)
def test_a_wrong_address_gets_a_correct_example(text: str, right: str) -> None:
    with pytest.raises(ConfigError) as raised:
        Vigor().address(text)
    assert str(raised.value) == right


@pytest.mark.parametrize(
    ("address", "text"),
    [
        (Address("X", 15), "X17"),
        (Address("M9", 9003), "M9003"),
        (Address("T", 5), "T5"),
        (Address("C32", 200), "C200"),
        (Address("D9", 9001, 3), "D9001.3"),
    ],
)
def test_addresses_are_spelled_as_in_the_manual(address: Address, text: str) -> None:
    assert Vigor().spell(address) == text


@pytest.mark.parametrize("station", [-1, 256])
def test_a_station_number_is_0_to_255(station: int) -> None:
    with pytest.raises(ConfigError, match=rf"station {station} is not 0\.\.255"):
        Vigor(station=station)


# ---- what comes back ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("code", "refusal", "meaning"),
    [
        ("10", Refusal.DAMAGED, "ASCII conversion error"),
        ("11", Refusal.DAMAGED, "sum check error"),
        ("12", Refusal.OTHER, "no such command"),
        ("14", Refusal.DAMAGED, "stop bit, parity, frame or overrun error"),
        ("28", Refusal.ADDRESS, "data address out of range"),
        ("77", Refusal.OTHER, "unknown"),
    ],
)
async def test_b5_2_an_error_code_is_a_refusal(code: str, refusal: Refusal, meaning: str) -> None:
    back = encode(Reply(0, "51", code))
    with pytest.raises(Refused, match=meaning) as raised:
        await Vigor().read(Script(Vigor(), sent("vigor-003"), f"< {back.hex()}"), Span("D", 1, 2))
    assert (raised.value.code, raised.value.refusal) == (code, refusal)


async def test_a_refused_write_raises() -> None:
    request = encode(Request(5, "61", b"1C020225A3"))
    script = Script(Vigor(station=5), f"> {request.hex()}", heard("vigor-082"))
    with pytest.raises(Refused) as raised:
        await Vigor(station=5).write(script, Span("D", 1, 1), [0xA325])
    assert raised.value.code == "28"


@pytest.mark.parametrize(
    "reply",
    [
        Reply(1, "51", "00", bytes(4)),  # another station
        Reply(0, "61", "00"),  # a late answer to a write
        Reply(0, "61", "28"),
        Reply(0, "51", "00", bytes(2)),  # fewer words than asked for
        Reply(0, "51", "00", bytes(6)),
        Reply(0, "51", "00"),
        Reply(0, "51", "28", bytes(4)),  # a refusal carries no data
    ],
    ids=repr,
)
async def test_a_reply_to_some_other_question_is_no_answer(reply: Reply) -> None:
    stray = f"< {encode(reply).hex()}"
    script = Script(Vigor(), sent("vigor-003"), stray, heard("vigor-004"))
    assert list(await Vigor().read(script, Span("D", 1, 2))) == [0x1234, 0xABCD]
    script.done()


@pytest.mark.parametrize(
    "reply",
    [
        Reply(1, "61", "00"),
        Reply(0, "51", "00"),
        Reply(0, "70", "00"),
        Reply(0, "61", "00", b"\x00"),
    ],
    ids=repr,
)
async def test_a_write_is_not_done_because_something_else_was(reply: Reply) -> None:
    script = Script(Vigor(), sent("vigor-007"), f"< {encode(reply).hex()}")
    with pytest.raises(Garbled):
        await Vigor().write(script, Span("D", 1, 1), [0xA325])


async def test_the_echo_of_a_request_is_no_answer() -> None:
    echo = "< " + VECTORS["vigor-007"].frame.hex()
    script = Script(Vigor(), sent("vigor-007"), echo, heard("vigor-006"))
    assert await Vigor().write(script, Span("D", 1, 1), [0xA325])
    with pytest.raises(Garbled):
        await Vigor().write(Script(Vigor(), sent("vigor-007"), echo), Span("D", 1, 1), [0xA325])


SOUP = st.lists(
    st.one_of(
        st.binary(max_size=12),
        st.sampled_from([v.frame for v in VECTORS.values() if len(v.frame) < 40]),
        st.builds(
            Reply,
            st.sampled_from([0, 0, 1]),
            st.sampled_from(["51", "51", "61", "99"]),
            st.sampled_from(["00", "00", "10", "28", "ZZ"]),
            st.binary(max_size=5),
        ).map(encode),
    ),
    max_size=4,
)


@given(SOUP)
def test_whatever_comes_back_a_read_gives_values_or_a_device_error(pieces: list[bytes]) -> None:
    script = Script(Vigor(), sent("vigor-003"), *(f"< {piece.hex()}" for piece in pieces))
    try:
        values = play(Vigor().read(script, Span("D", 1, 2)))
    except DeviceError:
        return
    assert len(values) == 2
    assert all(0 <= value <= 0xFFFF for value in values)


@given(SOUP)
def test_whatever_comes_back_a_write_is_done_or_a_device_error(pieces: list[bytes]) -> None:
    script = Script(Vigor(), sent("vigor-007"), *(f"< {piece.hex()}" for piece in pieces))
    try:
        done = play(Vigor().write(script, Span("D", 1, 1), [0xA325]))
    except DeviceError:
        return
    assert done is True
    assert VECTORS["vigor-006"].frame in b"".join(pieces)


# ---- writing -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("span", "units"),
    [
        (Span("D", 0, 2), [1]),
        (Span("D", 0, 1), [0x10000]),
        (Span("D", 0, 1), [-1]),
        (Span("C32", 200, 1), [1 << 32]),
        (Span("M", 0, 1), [2]),
        (Span("D", 8191, 2), [0, 0]),
        (Span("D", 0, 65), [0] * 65),
        (Span("D", 0, 0), []),
        (Span("holding", 0, 1), [0]),
        (Span("C", 200, 1), [0]),
    ],
)
async def test_an_impossible_write_is_refused_before_anything_is_sent(
    span: Span, units: list[int]
) -> None:
    with pytest.raises(BadValue):
        await Vigor().write(Script(Vigor()), span, units)


async def test_an_impossible_read_is_refused_before_anything_is_sent() -> None:
    with pytest.raises(ConfigError, match="not in one request"):
        await Vigor().read(Script(Vigor()), Span("D", 0, 65))


async def test_a_contact_is_written_with_its_neighbours_as_they_were() -> None:
    station = VigorStation(0)
    station.memory.write("TS", 0, bits("10100110"))
    wire = bus(lambda data: station.hear(data, 0.0))
    assert await Vigor().write(wire, Span("TS", 3, 1), [1])
    assert station.memory.read("TS", 0, 8) == bits("10101110")
    assert wire.cost == Vigor().write_cost(Span("TS", 3, 1)) == Cost(14 + 16, 12 + 10)


async def test_neighbours_that_cannot_be_read_stop_the_write() -> None:
    station = VigorStation(0, holes={("M", 0)})
    wire = bus(lambda data: station.hear(data, 0.0))
    with pytest.raises(Refused):
        await Vigor().write(wire, Span("M", 2, 3), [1, 1, 1])
    assert station.memory.read("M", 0, 8) == [0] * 8


# ---- any span, against an image of the PLC's bytes ----------------------------------------

# Base addresses as the manual prints them.
PRINTED = {
    "X": 0x0000, "Y": 0x0040, "M": 0x0080, "S": 0x0300, "TS": 0x0380, "CS": 0x03A0, "M9": 0x03E0,
    "TC": 0x0780, "CC": 0x07A0, "T": 0x1400, "D9": 0x1600, "C": 0x1800, "C32": 0x1A00, "D": 0x1C00,
}  # fmt: skip


class Image:
    """A PLC that is nothing but 64 KiB: 51 and 61 move bytes, 70 and 71 set a bit."""

    def __init__(self, data: bytes) -> None:
        self.bits = int.from_bytes(data, "little")

    def slice(self, at: int, size: int) -> int:
        return self.bits >> at & (1 << size) - 1

    def put(self, at: int, size: int, value: int) -> None:
        self.bits ^= (self.slice(at, size) ^ value) << at

    def hear(self, frame: bytes) -> list[bytes]:
        command, body, data = frame[3:5].decode(), frame[5:-3], b""
        at = int(body[:4], 16)
        if command in ("70", "71"):
            self.put(at, 1, int(command == "70"))
        else:
            count = int(body[4:6], 16)
            if command == "51":
                data = self.slice(8 * at, 8 * count).to_bytes(count, "little")
            else:
                given_data = bytes.fromhex(body[6:].decode())
                assert len(given_data) == count
                self.put(8 * at, 8 * count, int.from_bytes(given_data, "little"))
        return [encode(Reply(0, command, "00", data))]


@st.composite
def spans(draw: st.DrawFn) -> Span:
    area = AREAS[draw(st.sampled_from(sorted(AREAS)))]
    most = min(1024 // UNIT_BITS[area.unit], area.last - area.first + 1)
    size = draw(st.integers(1, 24) | st.integers(1, most))
    size = min(size, most)
    return Span(area.name, draw(st.integers(area.first, area.last - size + 1)), size)


def where(span: Span) -> tuple[int, int]:
    """The bits of a span: place in the image, and bits of one unit."""
    width = UNIT_BITS[AREAS[span.area].unit]
    return 8 * PRINTED[span.area] + (span.start - AREAS[span.area].first) * width, width


def random_image(data: st.DataObject) -> Image:
    seed = data.draw(st.binary(min_size=7, max_size=7))
    return Image((seed * 10_000)[:0x5C00])


@settings(max_examples=60)
@given(spans(), st.data())
def test_reading_any_span_returns_the_bytes_of_the_plc_at_exactly_its_cost(
    span: Span, data: st.DataObject
) -> None:
    cost = Vigor().cost(span)
    if cost is None:
        assert AREAS[span.area].unit is Unit.BIT
        assert span.size > 1024 - 7
        return
    image = random_image(data)
    at, width = where(span)
    wire = bus(image.hear)
    expected = [image.slice(at + i * width, width) for i in range(span.size)]
    assert list(play(Vigor().read(wire, span))) == expected
    assert wire.cost == cost


@settings(max_examples=60)
@given(spans(), st.data())
def test_writing_any_span_changes_it_and_nothing_else(span: Span, data: st.DataObject) -> None:
    cost = Vigor().write_cost(span)
    if cost is None:
        assert Vigor().cost(span) is None
        return
    image, expected = random_image(data), random_image(data)
    expected.bits = image.bits
    at, width = where(span)
    pattern = data.draw(st.integers(0, (1 << min(width * span.size, 64)) - 1))
    units = [pattern * (i + 1) >> i & (1 << width) - 1 for i in range(span.size)]
    for i, unit in enumerate(units):
        expected.put(at + i * width, width, unit)
    wire = bus(image.hear)
    assert play(Vigor().write(wire, span, units)) is True
    assert image.bits == expected.bits
    assert wire.cost == cost


@settings(max_examples=60)
@given(spans(), st.data())
def test_driver_and_station_agree_on_every_device(span: Span, data: st.DataObject) -> None:
    if Vigor().write_cost(span) is None:
        return
    largest = (1 << UNIT_BITS[AREAS[span.area].unit]) - 1
    pattern = data.draw(st.integers(0, largest))
    units = [(pattern + 7 * i) & largest for i in range(span.size)]
    station = VigorStation(0)
    wire = bus(lambda heard: station.hear(heard, 0.0))
    assert play(Vigor().write(wire, span, units))
    assert station.memory.read(span.area, span.start, span.size) == units
    assert list(play(Vigor().read(wire, span))) == units


@pytest.mark.parametrize(
    ("span", "cost"),
    [
        (Span("D", 0, 64), Cost(14, 266)),
        (Span("C32", 200, 32), Cost(14, 266)),
        (Span("M", 0, 1024), Cost(14, 266)),
        (Span("M", 7, 2), Cost(14, 14)),
        (Span("D", 0, 65), None),
        (Span("C32", 200, 33), None),
        (Span("M", 1, 1024), None),
        (Span("D", 8191, 2), None),
        (Span("D9", 8999, 2), None),
        (Span("C", 199, 2), None),
        (Span("D", 0, 0), None),
        (Span("D", -1, 1), None),
        (Span("R", 0, 1), None),
    ],
)
def test_one_exchange_carries_128_bytes_of_one_area(span: Span, cost: Cost | None) -> None:
    assert Vigor().cost(span) == cost


@pytest.mark.parametrize(
    ("span", "cost"),
    [
        (Span("D", 0, 64), Cost(270, 10)),
        (Span("M", 10, 1), Cost(12, 10)),
        (Span("M9", 9001, 1), Cost(12, 10)),
        (Span("Y", 8, 16), Cost(18, 10)),
        (Span("Y", 9, 2), Cost(14 + 16, 12 + 10)),
        (Span("M", 1, 1024), None),
    ],
)
def test_a_write_costs_its_exchanges(span: Span, cost: Cost | None) -> None:
    assert Vigor().write_cost(span) == cost


# ---- resync ------------------------------------------------------------------------------


class Questions:
    """Hears requests and notes how many bytes each reads; refuses the first `refuse`."""

    def __init__(self, refuse: int = 0) -> None:
        self.counts: list[int] = []
        self._refuse = refuse

    def hear(self, frame: bytes) -> list[bytes]:
        assert frame[3:9] == b"510080"
        self.counts.append(int(frame[9:11], 16))
        if len(self.counts) <= self._refuse:
            return [VECTORS["vigor-081"].frame]
        return [encode(Reply(0, "51", "00", bytes(self.counts[-1])))]


@pytest.mark.parametrize(
    "doubt", [None, Span("D", 0, 3), Span("M", 3, 20), Span("X", 0, 8), Span("R", 0, 1)]
)
async def test_a_resync_differs_from_the_outstanding_read_and_the_resync_before(
    doubt: Span | None,
) -> None:
    cost = Vigor().cost(doubt) if doubt else None
    doubted = (cost.reply - 10) // 2 if cost else 0
    before = 0
    for salt in range(0, 40, 2):
        questions = Questions()
        await Vigor().resync(bus(questions.hear), doubt, salt)
        (count,) = questions.counts
        assert count % 2 == 1
        assert count <= 15
        assert count not in (doubted, before)
        before = count


async def test_a_late_refusal_is_not_taken_for_the_resyncs_answer() -> None:
    questions = Questions(refuse=1)
    await Vigor().resync(bus(questions.hear), None, 3)
    assert len(set(questions.counts)) == 2


async def test_a_refused_resync_asks_nothing_that_the_next_one_asks() -> None:
    before: set[int] = set()
    for salt in range(0, 40, 2):
        questions = Questions(refuse=1)
        await Vigor().resync(bus(questions.hear), Span("M", 3, 20), salt)
        assert before.isdisjoint(questions.counts)
        before = set(questions.counts)


async def test_a_plc_that_refuses_every_resync_raises_refused() -> None:
    """The caller decides: the error replies may belong to older requests."""
    questions = Questions(refuse=9)
    with pytest.raises(Refused):
        await Vigor().resync(bus(questions.hear), None, 0)
    assert len(set(questions.counts)) == 2


async def test_a_resync_without_an_answer_is_no_reply() -> None:
    with pytest.raises(NoReply):
        await Vigor().resync(bus(lambda _: []), None, 0)


# ---- the codec and noise -----------------------------------------------------------------

GOOD = [v.frame for v in RESPONSES if len(v.frame) < 40]
Outcome = tuple[list[Frame], Evidence | None]


def hear(pieces: list[bytes]) -> Outcome:
    """The frames in a stream, and what was wrong where it ended early."""
    codec, frames = VigorCodec(), list[Frame]()
    try:
        for piece in [*pieces, b""]:
            frames += codec.feed(piece)
    except Garbled as garbled:
        return frames, garbled.evidence
    return frames, None


@st.composite
def streams(draw: st.DrawFn) -> bytes:
    part = st.binary(max_size=9) | st.sampled_from(GOOD) | st.text("\x02\x03\x06 0A", max_size=9)
    parts = draw(st.lists(part, max_size=6))
    return b"".join(p if isinstance(p, bytes) else p.encode() for p in parts)


@given(streams(), st.data())
def test_a_stream_means_the_same_however_it_is_cut(stream: bytes, data: st.DataObject) -> None:
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)))))
    pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    whole = hear([stream])
    assert hear(pieces) == whole
    assert hear([bytes([byte]) for byte in stream]) == whole


@given(st.sampled_from(GOOD), st.binary(max_size=40), st.binary(max_size=40))
def test_a_reply_is_found_in_noise_unless_the_noise_looks_like_one(
    frame: bytes, before: bytes, after: bytes
) -> None:
    reply = VigorCodec().feed(frame)
    frames, evidence = hear([before, frame, after])
    assert evidence is not None or reply[0] in frames
    assert hear([before.replace(b"\x06", b""), frame, after])[0][:1] == reply


@pytest.mark.parametrize("frame", GOOD, ids=lambda frame: frame.hex())
def test_an_ack_in_the_noise_does_not_hide_the_reply(frame: bytes) -> None:
    for noise in (b"\x06", b"\x06\x06", b"\x0600", b"\x06\xff", b"\x06000\x03", b"\x0600510\x0300"):
        assert hear([noise + frame]) == hear([frame])


@pytest.mark.parametrize("frame", GOOD, ids=lambda frame: frame.hex())
def test_a_reply_that_begins_again_is_found(frame: bytes) -> None:
    for cut in range(1, len(frame)):
        assert hear([frame[:cut] + frame]) == hear([frame])


@given(st.sampled_from(GOOD), st.data())
def test_one_wrong_character_never_gives_another_frame(frame: bytes, data: st.DataObject) -> None:
    at = data.draw(st.integers(0, len(frame) - 1))
    wrong = data.draw(st.integers(0, 255).filter(lambda byte: byte != frame[at]))
    frames, _ = hear([frame[:at] + bytes([wrong]) + frame[at + 1 :]])
    assert frames == []


def test_a_wrong_sum_is_named() -> None:
    frame = VECTORS["vigor-004"].frame
    assert hear([frame[:-1] + b"E"]) == ([], Evidence.CHECKSUM)


def test_lower_case_is_no_hex_on_this_wire() -> None:
    frame = VECTORS["vigor-004"].frame
    assert hear([frame.replace(b"CDAB", b"cdab")]) == ([], Evidence.NOISE)


def test_half_a_byte_of_data_is_of_the_wrong_shape() -> None:
    # A request with this body has the sum that such a reply would have.
    odd = b"\x06" + encode(Request(0, "51", b"00ABC"))[1:]
    assert hear([odd]) == ([], Evidence.SHAPE)


def test_a_reply_longer_than_128_bytes_has_no_end() -> None:
    longest = VECTORS["vigor-054"].frame
    assert len(longest) == 266
    assert hear([longest[:-3]]) == ([], None)
    assert hear([longest[:-3] + b"0"]) == ([], Evidence.TRUNCATED)


def test_replies_before_the_damage_are_handed_out_first() -> None:
    good = VECTORS["vigor-004"].frame
    codec = VigorCodec()
    assert len(codec.feed(good + good[:-1] + b"E")) == 1
    with pytest.raises(Garbled, match="wrong sum"):
        codec.feed(b"")


def test_endless_noise_is_not_kept() -> None:
    codec = VigorCodec()
    for _ in range(50):
        assert codec.feed(b"\x06\xff" + b"0" * 1000) == []
        assert len(codec._buffer) <= 266  # private: bounded memory has no other sign
    assert len(codec.feed(VECTORS["vigor-054"].frame)) == 1


def test_a_vigor_is_a_driver() -> None:
    driver: Driver[Frame] = Vigor(station=7)
    assert (driver.protocol, driver.station) == ("vigor", 7)
    assert driver.timing.reply_timeout == 0.5
