"""The simulated Modbus slave against the vectors and pymodbus, and when it keeps silent."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.pdu.bit_message import ReadCoilsRequest, WriteMultipleCoilsRequest
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from gateway.protocols.driver import Span
from gateway.protocols.modbus import Frame, ModbusAscii, ModbusRtu, ModbusTcp
from gateway.stations.modbus import ModbusStation
from tests.protocols.modbus_peer import KINDS, hearing, oracle_decodes, oracle_encodes
from tests.vectors import Vector, vectors

FRAMINGS = {ModbusRtu: "rtu", ModbusAscii: "ascii", ModbusTcp: "tcp"}
REQUESTS = [
    vector
    for vector in vectors("modbus-rtu", "modbus-ascii")
    if vector.direction == "request" and vector.valid
]
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3


def slave(vector: Vector) -> ModbusStation:
    return ModbusStation(
        station=vector.fields["unit"] or 1,
        framing="rtu" if vector.protocol == "modbus-rtu" else "ascii",
        dialect=vector.fields.get("dialect", "plain"),
    )


def ask(station: ModbusStation, pdu: bytes, unit: int = 1) -> bytes | None:
    """The PDU that answers, over RTU; None for silence."""
    codec = ModbusRtu(station=1).codec()
    answers = station.hear(codec.encode(Frame(unit, pdu)), 0.0)
    assert len(answers) <= 1
    return answers[0][1:-2] if answers else None


@pytest.mark.parametrize("vector", REQUESTS, ids=repr)
def test_every_request_of_the_manuals_is_answered(vector: Vector) -> None:
    station = slave(vector)
    answers = station.hear(vector.frame, 0.0)
    if vector.fields["unit"] == 0:
        assert answers == []
        return
    kind = ModbusRtu if vector.protocol == "modbus-rtu" else ModbusAscii
    answer = oracle_decodes(kind, answers[0], vector.fields["unit"], requests=False)
    assert answer.function_code == vector.fields["function"]


@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        ("modbus-rtu-001", "modbus-rtu-002"),
        ("modbus-rtu-003", "modbus-rtu-004"),
        ("modbus-rtu-007", "modbus-rtu-008"),
        ("modbus-rtu-009", "modbus-rtu-010"),
        ("modbus-rtu-043", "modbus-rtu-044"),
        ("modbus-ascii-001", "modbus-ascii-002"),
        ("modbus-ascii-011", "modbus-ascii-012"),
        ("modbus-ascii-032", "modbus-ascii-033"),
    ],
)
def test_the_manuals_answers_are_given(asked: str, answered: str) -> None:
    by_id = {vector.id: vector for vector in vectors("modbus-rtu", "modbus-ascii")}
    assert slave(by_id[asked]).hear(by_id[asked].frame, 0.0) == [by_id[answered].frame]


@pytest.mark.parametrize("name", ["modbus-rtu-084", "modbus-rtu-085"])
def test_a_broken_request_is_met_with_silence(name: str) -> None:
    vector = next(v for v in vectors("modbus-rtu") if v.id == name)
    assert ModbusStation().hear(vector.frame, 0.0) == []


def test_a_broadcast_is_done_and_not_answered() -> None:
    vector = next(v for v in vectors("modbus-rtu") if v.id == "modbus-rtu-005")
    station = ModbusStation(station=9, dialect="ex485lnk")
    assert station.hear(vector.frame, 0.0) == []
    assert station.memory.read("holding", 4, 2) == [0x4321, 0x8765]


def test_a_k120s_does_not_do_broadcasts() -> None:
    station = ModbusStation(dialect="k120s")
    assert ask(station, bytes.fromhex("0680000005"), unit=0) is None
    assert station.memory.read("D", 0) == [0]


def test_another_stations_request_is_met_with_silence() -> None:
    assert ask(ModbusStation(station=2), bytes.fromhex("0300000001"), unit=1) is None


def test_a_mute_station_neither_answers_nor_does() -> None:
    station = ModbusStation(mute=True)
    assert ask(station, bytes.fromhex("0600000005")) is None
    station.mute = False
    assert ask(station, bytes.fromhex("0300000001")) == bytes.fromhex("03020000")


def test_half_a_request_is_forgotten_after_a_silence() -> None:
    station, codec = ModbusStation(gap=0.1), ModbusRtu(station=1).codec()
    request = codec.encode(Frame(1, bytes.fromhex("0300000001")))
    assert station.hear(request[:4], 0.0) == []
    assert len(station.hear(request[4:], 0.05)) == 1
    many = codec.encode(Frame(1, bytes.fromhex("100000000408") + bytes(8)))
    assert station.hear(many[:9], 1.0) == []
    assert len(station.hear(request, 1.2)) == 1


@pytest.mark.parametrize(
    ("dialect", "pdu", "code"),
    [
        ("plain", "2B0E0100", ILLEGAL_FUNCTION),
        ("plain", "070000", ILLEGAL_FUNCTION),
        ("ex485lnk", "0100000001", ILLEGAL_FUNCTION),
        ("plain", "0300000000", ILLEGAL_VALUE),
        ("plain", "030000007E", ILLEGAL_VALUE),
        ("plain", "01000007D1", ILLEGAL_VALUE),
        ("plain", "0500001234", ILLEGAL_VALUE),
        ("plain", "100000000203000000", ILLEGAL_VALUE),  # byte count 3 for two registers
        ("plain", "0F000000090101", ILLEGAL_VALUE),  # one byte for nine coils
        ("plain", "03FFFF007E", ILLEGAL_VALUE),  # the count is looked at before the address
        ("plain", "03FFFF0002", ILLEGAL_ADDRESS),
        ("plain", "0323280001", ILLEGAL_ADDRESS),  # the hole
        ("plain", "0323270002", ILLEGAL_ADDRESS),
        ("vigor", "0119E70002", ILLEGAL_ADDRESS),  # S999 and coil 6632
        ("vigor", "011BFF0002", ILLEGAL_ADDRESS),  # C255 and coil 7168
        ("vigor", "0323370002", ILLEGAL_ADDRESS),  # D9255 and register 9016
        ("vigor", "0202000001", ILLEGAL_ADDRESS),
        ("k120s", "0541000000", ILLEGAL_ADDRESS),  # F is read only
        ("k120s", "0393880001", ILLEGAL_ADDRESS),  # D5000
    ],
)
def test_exceptions_come_in_the_standards_order(dialect: Any, pdu: str, code: int) -> None:
    station = ModbusStation(dialect=dialect, holes=[("holding", 9000, 9099)])
    request = bytes.fromhex(pdu)
    assert ask(station, request) == bytes((request[0] | 0x80, code))


def test_function_08_repeats_its_data_where_it_is_served() -> None:
    question = bytes.fromhex("080000A55A")
    assert ask(ModbusStation(), question) == question
    assert ask(ModbusStation(diagnostics=False), question) == b"\x88\x01"


def test_k120s_ascii_keeps_to_frames_of_128_characters() -> None:
    for count, good in ((29, True), (30, False)):
        codec = ModbusAscii(station=1).codec()
        question = codec.encode(Frame(1, bytes.fromhex(f"038000{count:04X}")))
        answer = ModbusStation(framing="ascii", dialect="k120s").hear(question, 0.0)[0]
        assert len(answer) <= 128
        assert (answer[3:5] == b"03") is good


def test_vigor_counters_from_c200_show_as_pairs_of_registers() -> None:
    low = ModbusStation(dialect="vigor")
    high = ModbusStation(dialect="vigor", counter_word_order="high_first")
    for station, words in ((low, "56781234"), (high, "12345678")):
        station.memory.write("C32", 255, [0x12345678])
        assert ask(station, bytes.fromhex("0322360002")) == bytes.fromhex(f"0304{words}")
        half = words[:4] if station is high else words[4:]
        index = "2236" if station is high else "2237"
        assert ask(station, bytes.fromhex(f"03{index}0001")) == bytes.fromhex(f"0302{half}")
        assert ask(station, bytes.fromhex(f"06{index}ABCD")) is not None
        assert station.memory.read("C32", 255) == [0xABCD5678]


def test_k120s_relays_are_words_and_bits_at_once() -> None:
    station = ModbusStation(dialect="k120s")
    station.memory.write("M", 0x15, [1])  # M0015
    assert ask(station, bytes.fromhex("0310010001")) == bytes.fromhex("03020020")
    assert ask(station, bytes.fromhex("0610018001")) is not None
    assert station.memory.read("M", 0x10, 16) == [1, *[0] * 14, 1]
    station.memory.write("MW", 1, [2])
    assert ask(station, bytes.fromhex("0110100010")) == bytes.fromhex("01020200")
    station.memory.animate("MW", 1, lambda now: 4)
    assert ask(station, bytes.fromhex("0110100010")) == bytes.fromhex("01020400")


@settings(max_examples=100)
@given(
    st.sampled_from(KINDS),
    st.integers(0, 65535),
    st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=123),
    st.lists(st.booleans(), min_size=1, max_size=100),
)
def test_pymodbus_reads_back_its_own_writes(
    kind: type, start: int, words: list[int], bits: list[bool]
) -> None:
    framing: Any = FRAMINGS[kind]
    station = ModbusStation(station=7, framing=framing)
    start = min(start, 65536 - max(len(words), len(bits)))

    def converse(request: Any) -> Any:
        request.dev_id = 7
        answers = station.hear(oracle_encodes(kind, request), 0.0)
        return oracle_decodes(kind, answers[0], 7, requests=False)

    assert not converse(WriteMultipleRegistersRequest(address=start, registers=words)).isError()
    converse(WriteSingleRegisterRequest(address=start, registers=[words[0] ^ 1]))
    read = converse(ReadHoldingRegistersRequest(address=start, count=len(words)))
    assert list(read.registers) == [words[0] ^ 1, *words[1:]]
    assert not converse(WriteMultipleCoilsRequest(address=start, bits=bits)).isError()
    read = converse(ReadCoilsRequest(address=start, count=len(bits)))
    assert list(read.bits)[: len(bits)] == bits


@settings(max_examples=200)
@given(st.sampled_from(KINDS), st.sampled_from(["plain", "vigor", "k120s", "ex485lnk"]), st.data())
async def test_driver_and_station_agree_on_where_everything_is(
    kind: type, dialect: Any, data: st.DataObject
) -> None:
    """Their address tables were written apart."""
    framing: Any = FRAMINGS[kind]
    driver = kind(station=3, addressing=dialect, write_single=data.draw(st.booleans()))
    station = ModbusStation(station=3, framing=framing, dialect=dialect)
    area = data.draw(st.sampled_from(sorted(driver.areas.values(), key=lambda a: a.name)))
    largest = {"bit": 1, "word": 0xFFFF, "dword": 0xFFFF_FFFF}[area.unit]
    start = data.draw(st.one_of(st.just(area.last), st.integers(area.first, area.last)))
    size = min(27, area.last - start + 1)
    units = data.draw(st.lists(st.integers(0, largest), min_size=1, max_size=size))
    span = Span(area.name, start, len(units))
    if area.writable:
        talk = hearing(driver, lambda sent: station.hear(sent, 0.0))
        assert await driver.write(talk, span, units) is True
        assert station.memory.read(area.name, start, len(units)) == units
    else:
        station.memory.write(area.name, start, units)
    talk = hearing(driver, lambda sent: station.hear(sent, 0.0))
    assert list(await driver.read(talk, span)) == units


@settings(max_examples=150)
@given(st.sampled_from(sorted(FRAMINGS.values())), st.lists(st.binary(max_size=30), max_size=6))
def test_any_bytes_are_answered_or_passed_over(framing: Any, pieces: list[bytes]) -> None:
    station = ModbusStation(framing=framing)
    for piece in pieces:
        assert all(station.hear(piece, 0.0))


@settings(max_examples=150)
@given(st.binary(min_size=1, max_size=30), st.sampled_from(["plain", "vigor", "k120s"]))
def test_any_request_is_answered_or_refused(pdu: bytes, dialect: Any) -> None:
    station, codec = ModbusStation(framing="tcp", dialect=dialect), ModbusTcp().codec()
    for answer in station.hear(codec.encode(Frame(1, pdu, 77)), 0.0):
        frame = codec.feed(answer)[0]
        assert frame.transaction == 77
        assert frame.pdu[0] & 0x7F == pdu[0]


@pytest.mark.parametrize("kind", [ModbusAscii, ModbusTcp])
def test_where_frames_have_a_beginning_a_pause_inside_one_does_no_harm(kind: type) -> None:
    framing: Any = FRAMINGS[kind]
    station = ModbusStation(framing=framing)
    request = kind(station=1).codec().encode(Frame(1, bytes.fromhex("0300000001")))
    assert station.hear(request[:5], 0.0) == []
    assert len(station.hear(request[5:], 0.9)) == 1
