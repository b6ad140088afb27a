"""The Modbus drivers: addresses, limits, what counts as an answer, writes, resynchronising."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from sys import getsizeof
from typing import Any, TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import BadValue, ConfigError, DeviceError, NoReply, Refusal, Refused, Took
from gateway.planning.wire_timing import WireTiming
from gateway.protocols.driver import Address, Cost, Driver, Span
from gateway.protocols.modbus import Frame, ModbusAscii, ModbusRtu, ModbusTcp
from gateway.protocols.modbus.pdu import words_in
from gateway.stations.modbus import ModbusStation
from tests.doubles import Script
from tests.protocols.modbus_peer import KINDS, hearing
from tests.vectors import vectors

T = TypeVar("T")
MODERATE = settings(max_examples=100, deadline=None)
DIALECTS = ("plain", "vigor", "k120s", "ex485lnk")
VECTORS = {v.id: v for v in vectors("modbus-rtu", "modbus-ascii")}


def pdu(name: str) -> bytes:
    return bytes.fromhex(VECTORS[name].fields["pdu"])


def framed(kind: type, station: int, body: bytes, number: int = 1) -> bytes:
    frame = Frame(station, body, number if kind is ModbusTcp else 0)
    coded: bytes = kind(station=station).codec().encode(frame)
    return coded


# ---- addresses -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings_", "text", "address"),
    [
        ({}, "holding:100", Address("holding", 100)),
        ({}, "holding:100.15", Address("holding", 100, 15)),
        ({}, "coil:5", Address("coil", 5)),
        ({}, "discrete:65535", Address("discrete", 65535)),
        ({"numbering": "modicon"}, "40101", Address("holding", 100)),
        ({"numbering": "modicon"}, "400101", Address("holding", 100)),
        ({"numbering": "modicon"}, "30001.3", Address("input", 0, 3)),
        ({"numbering": "modicon"}, "00020", Address("coil", 19)),
        ({"numbering": "modicon"}, "165536", Address("discrete", 65535)),
        ({"addressing": "vigor"}, "X17", Address("X", 0o17)),
        ({"addressing": "vigor"}, "C200", Address("C32", 200)),
        ({"addressing": "vigor"}, "CN199", Address("C", 199)),
        ({"addressing": "vigor"}, "M9003", Address("M9", 9003)),
        ({"addressing": "vigor"}, "D7.3", Address("D", 7, 3)),
        ({"addressing": "k120s"}, "M0010", Address("M", 16)),
        ({"addressing": "k120s"}, "M191F", Address("M", 191 * 16 + 15)),
        ({"addressing": "k120s"}, "F0110", Address("F", 11 * 16)),
        ({"addressing": "k120s"}, "F110", Address("F", 11 * 16)),  # as the manual writes it, 8.3.4
        ({"addressing": "k120s"}, "F112", Address("F", 11 * 16 + 2)),
        ({"addressing": "k120s"}, "F063", Address("FW", 63)),
        ({"addressing": "k120s"}, "M003", Address("MW", 3)),
        ({"addressing": "k120s"}, "M003.5", Address("MW", 3, 5)),
        ({"addressing": "k120s"}, "p001f", Address("P", 31)),
        ({"addressing": "k120s"}, "T5", Address("T", 5)),
        ({"addressing": "k120s"}, "TS005", Address("TS", 5)),
        ({"addressing": "k120s"}, "D0100", Address("D", 100)),
        ({"addressing": "ex485lnk"}, "BFM#4", Address("holding", 4)),
        ({"addressing": "ex485lnk"}, "holding:4", Address("holding", 4)),
    ],
)
def test_addresses_are_read_as_their_makers_write_them(
    settings_: dict[str, Any], text: str, address: Address
) -> None:
    driver = ModbusRtu(station=1, **settings_)
    assert driver.address(text) == address
    assert driver.address(driver.spell(address)) == address
    assert address.area in driver.areas


@pytest.mark.parametrize(
    ("settings_", "text", "hint"),
    [
        ({}, "40101", "numbering: modicon"),
        ({}, "holding:65536", "0 to 65535"),
        ({}, "coil:5.1", "a bit already"),
        ({}, "holding:5.16", r"\.0 to \.15"),
        ({}, "D100", "holding:100"),
        ({"numbering": "modicon"}, "holding:100", "40101"),
        ({"numbering": "modicon"}, "40000", "0001 to 65536"),
        ({"numbering": "modicon"}, "465537", "0001 to 65536"),
        ({"addressing": "vigor"}, "X8", "octal"),
        ({"addressing": "vigor"}, "D8192", "D8191"),
        ({"addressing": "vigor"}, "TC5", "there is no device TC"),
        ({"addressing": "vigor"}, "S1000", "S999"),
        ({"addressing": "vigor"}, "C200.1", "32 bits"),
        ({"addressing": "k120s"}, "M10", "M0010"),
        ({"addressing": "k120s"}, "L63F", "L0010"),
        ({"addressing": "k120s"}, "M0010.1", "hex"),
        ({"addressing": "k120s"}, "M2560", "000 to 255"),
        ({"addressing": "k120s"}, "F0640", "000 to 063"),
        ({"addressing": "k120s"}, "F110.3", "000 to 063"),
        ({"addressing": "k120s"}, "D5000", "D4999"),
        ({"addressing": "k120s"}, "X1", "P, M, L, K, F"),
        ({"addressing": "ex485lnk"}, "input:4", "BFM#4"),
    ],
)
def test_an_address_the_device_does_not_have_says_what_would_be_right(
    settings_: dict[str, Any], text: str, hint: str
) -> None:
    with pytest.raises(ConfigError, match=hint):
        ModbusRtu(station=1, **settings_).address(text)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("kind", KINDS)
def test_every_address_survives_being_spelled(kind: type, dialect: Any) -> None:
    driver: Driver[Frame] = kind(station=1, addressing=dialect)
    for area in driver.areas.values():
        numbers = {area.first, area.last, *range(area.first, area.last, 97)}
        for number in numbers:
            address = Address(area.name, number)
            assert driver.address(driver.spell(address)) == address


# ---- settings --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings_", "hint"),
    [
        (ModbusRtu, {"station": 248}, "0..247"),
        (ModbusRtu, {"station": 0, "addressing": "k120s"}, r"1\.\.31"),
        (ModbusTcp, {"station": 32, "addressing": "k120s"}, r"1\.\.31"),
        (ModbusTcp, {"station": 256}, "0..255"),
        (ModbusTcp, {"window": 0}, "window"),
        (ModbusAscii, {"station": 1, "max_read_words": 126}, "max_read_words 126"),
        (ModbusAscii, {"station": 1, "max_write_bits": 0}, "max_write_bits 0"),
        (ModbusRtu, {"station": 1, "addressing": "vigor", "numbering": "modicon"}, "plain"),
    ],
)
def test_settings_out_of_range_are_refused(
    kind: type, settings_: dict[str, Any], hint: str
) -> None:
    with pytest.raises(ConfigError, match=hint):
        kind(**settings_)


def test_rtu_keeps_3_5_characters_of_silence_and_1_75_ms_above_19200_baud() -> None:
    timing = ModbusRtu(station=1).timing
    assert WireTiming(9600, 11).silence(timing) == pytest.approx(3.5 * 11 / 9600)
    assert WireTiming(19200, 11).silence(timing) == pytest.approx(3.5 * 11 / 19200)
    assert WireTiming(38400, 11).silence(timing) == pytest.approx(0.00175)


def test_ex485lnk_keeps_10_ms_of_silence_or_3_5_characters() -> None:
    timing = ModbusRtu(station=1, addressing="ex485lnk").timing
    assert WireTiming(9600, 11).silence(timing) == pytest.approx(0.010)
    assert WireTiming(1200, 11).silence(timing) == pytest.approx(3.5 * 11 / 1200)


# ---- limits and costs ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings_", "words", "bits", "out_words", "out_bits"),
    [
        (ModbusRtu, {}, 125, 2000, 123, 1968),
        (ModbusTcp, {}, 125, 2000, 123, 1968),
        (ModbusAscii, {"addressing": "k120s"}, 29, 464, 27, 432),
        (ModbusRtu, {"addressing": "k120s"}, 125, 2000, 123, 1968),
        (ModbusRtu, {"max_read_words": 10, "max_write_bits": 5}, 10, 2000, 123, 5),
    ],
)
def test_no_exchange_is_longer_than_the_device_takes(
    kind: type, settings_: dict[str, Any], words: int, bits: int, out_words: int, out_bits: int
) -> None:
    driver: Driver[Frame] = kind(station=1, **settings_)
    word, bit = ("D", "M") if "addressing" in settings_ else ("holding", "coil")
    for cost, area, most in (
        (driver.cost, word, words),
        (driver.cost, bit, bits),
        (driver.write_cost, word, out_words),
        (driver.write_cost, bit, out_bits),
    ):
        assert cost(Span(area, 0, most)) is not None
        assert cost(Span(area, 0, most + 1)) is None


def test_k120s_ascii_frames_are_at_most_128_characters() -> None:
    driver = ModbusAscii(station=1, addressing="k120s")
    costs = [
        driver.cost(Span("D", 0, 29)),
        driver.cost(Span("M", 0, 464)),
        driver.write_cost(Span("D", 0, 27)),
        driver.write_cost(Span("M", 0, 432)),
    ]
    assert [max(cost) for cost in costs if cost] == [127, 127, 127, 127]


def test_ex485lnk_reads_and_writes_32_registers_by_functions_03_and_16() -> None:
    driver = ModbusRtu(station=32, addressing="ex485lnk")
    assert set(driver.areas) == {"holding"}
    assert driver.cost(Span("holding", 0, 32)) == Cost(8, 69)
    assert driver.cost(Span("holding", 0, 33)) is None
    assert driver.write_cost(Span("holding", 0, 1)) == Cost(11, 8)  # never function 06


@pytest.mark.parametrize(
    "span",
    [
        Span("holding", 65535, 2),
        Span("holding", -1, 1),
        Span("holding", 0, 0),
        Span("nowhere", 0, 1),
    ],
)
async def test_a_span_outside_the_device_is_not_requested(span: Span) -> None:
    driver = ModbusRtu(station=1)
    assert driver.cost(span) is None
    assert driver.write_cost(span) is None
    with pytest.raises(BadValue):
        await driver.read(Script(driver), span)


def test_vigor_holes_belong_to_no_area() -> None:
    driver = ModbusRtu(station=1, addressing="vigor")
    assert driver.cost(Span("S", 999, 1)) is not None
    assert driver.cost(Span("S", 999, 2)) is None  # coils 6632 to 6655
    assert driver.cost(Span("CS", 255, 2)) is None  # coils 7168 to 7423
    assert driver.write_cost(Span("X", 0, 1)) is None


# ---- what is an answer -----------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("station", "body"),
    [
        (2, pdu("modbus-rtu-002")),  # another station
        (1, pdu("modbus-rtu-041")),  # function 04
        (1, bytes((3, 2)) + bytes(2)),  # one register instead of two: a late answer
        (1, bytes((3, 6)) + bytes(6)),
        (1, pdu("modbus-rtu-001")),  # the question itself
    ],
)
async def test_only_the_requested_station_function_and_byte_count_are_accepted(
    kind: type, station: int, body: bytes
) -> None:
    driver = kind(station=1)
    wrong = framed(kind, station, body)
    right = framed(kind, 1, pdu("modbus-rtu-002"))
    with pytest.raises(NoReply):
        await driver.read(hearing(driver, [wrong]), Span("holding", 0, 2))
    talk = hearing(kind(station=1), [wrong, right])
    assert list(await kind(station=1).read(talk, Span("holding", 0, 2))) == [0, 0]


@pytest.mark.parametrize("kind", KINDS)
async def test_an_exception_to_another_function_is_a_refusal_where_its_number_names_the_request(
    kind: type,
) -> None:
    driver = kind(station=1)
    refusal = Frame(1, bytes((0x84, 2)))
    talk = hearing(driver, [framed(kind, 1, refusal.pdu)])
    with pytest.raises(Refused if kind is ModbusTcp else NoReply):
        await driver.read(talk, Span("holding", 0, 2))
    error = driver.refusal_of_another(refusal)
    assert str(error) == "exception 02 to function 04, which was not sent"
    assert error.code == "02"
    assert driver.refusal_of_another(Frame(2, refusal.pdu)) is None
    assert driver.refusal_of_another(Frame(1, bytes((4, 2)))) is None


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
@pytest.mark.parametrize("echo", [True, False])
async def test_coils_equal_to_the_echo_of_the_request_are_read_in_two_parts(
    kind: type, echo: bool
) -> None:
    """24 coils from wire address 0300h: 01 03 00 00 18 is the question, and can be the answer."""
    driver, span = kind(station=1), Span("coil", 0x0300, 24)
    station = ModbusStation(framing="rtu" if kind is ModbusRtu else "ascii")
    bits = [0] * 19 + [1, 1, 0, 0, 0]
    for shown in (bits, [1] * 24):
        station.memory.write("coil", 0x0300, shown)
        talk = hearing(driver, *[lambda sent: [sent] * echo + station.hear(sent, 0.0)] * 3)
        assert list(await driver.read(talk, span)) == shown
    assert len(talk.sent) == (3 if echo else 1)


async def test_modbus_tcp_takes_the_answer_of_its_own_number_alone() -> None:
    driver = ModbusTcp()
    talk = hearing(
        driver,
        [framed(ModbusTcp, 1, bytes((3, 2, 0, 1)), 1)],
        [framed(ModbusTcp, 1, bytes((3, 2, 0, 9)), number) for number in (1, 3, 0)],
        [framed(ModbusTcp, 1, bytes((3, 2, 0, number)), number) for number in (1, 2, 3)],
    )
    span = Span("holding", 0, 1)
    assert list(await driver.read(talk, span)) == [1]
    with pytest.raises(NoReply):
        await driver.read(talk, span)
    assert list(await driver.read(talk, span)) == [3]


def test_words_of_a_read_take_two_bytes_each_and_a_short_reply_has_none() -> None:
    words = words_in(124)
    reply = bytes((3, 248)) + bytes(range(248))
    found = words(reply)
    assert list(found) == [256 * byte + byte + 1 for byte in range(0, 248, 2)]
    assert words(bytes(bytearray(reply))) is found  # equal: they are not compared one by one
    assert getsizeof(found) < 400
    for _ in range(2):
        with pytest.raises(ValueError, match="not 124"):
            words(reply[:-2])


async def test_modbus_tcp_numbers_go_round() -> None:
    driver, numbers = ModbusTcp(), []

    class Numbering:
        may_echo = False

        async def ask(self, frame: Frame, reply: int, answers: object) -> list[int]:
            numbers.append(frame.transaction)
            return [0]

    for _ in range(65537):
        await driver.read(Numbering(), Span("holding", 0, 1))  # type: ignore[arg-type]  # no `tell`
    assert [*numbers[65535:], numbers[1]] == [0, 1, 2]
    assert len(set(numbers)) == 65536


class Answering:
    """A talk on which several questions are open; the answers come in the other order."""

    may_echo = False

    def __init__(self, driver: ModbusTcp, station: ModbusStation, open_at_once: int) -> None:
        self._codec, self._station, self._wanted = driver.codec(), station, open_at_once
        self._asked: list[tuple[bytes, Callable[[Frame], Any], asyncio.Future[Any]]] = []

    async def tell(self, frame: Frame) -> None:
        raise AssertionError("nothing is broadcast")

    async def ask(self, frame: Frame, reply: int, answers: Callable[[Frame], T | None]) -> T:
        future: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._asked.append((self._codec.encode(frame), answers, future))
        if len(self._asked) == self._wanted:
            for question, _, _ in reversed(self._asked):
                for answer in self._station.hear(question, 0.0):
                    for heard in self._codec.feed(answer):
                        self._deliver(heard)
        return await future

    def _deliver(self, frame: Frame) -> None:
        for _, answers, future in self._asked:
            if not future.done() and (said := answers(frame)) is not None:
                future.set_result(said)
                return


async def test_modbus_tcp_keeps_several_questions_apart() -> None:
    driver, station = ModbusTcp(window=8), ModbusStation(framing="tcp")
    station.memory.write("holding", 0, range(8))
    talk = Answering(driver, station, 8)
    reads = (driver.read(talk, Span("holding", i, 1)) for i in range(8))
    assert [list(units) for units in await asyncio.gather(*reads)] == [[i] for i in range(8)]


@pytest.mark.parametrize(
    ("code", "refusal"),
    [
        (1, Refusal.OTHER),
        (2, Refusal.ADDRESS),
        (3, Refusal.OTHER),
        (4, Refusal.OTHER),
        (5, Refusal.BUSY),
        (6, Refusal.BUSY),
        (0x2A, Refusal.OTHER),
    ],
)
async def test_exceptions_become_the_errors_of_their_remedy(code: int, refusal: Refusal) -> None:
    driver = ModbusRtu(station=1)
    talk = hearing(driver, [framed(ModbusRtu, 1, bytes((0x83, code)))])
    with pytest.raises(Refused) as refused:
        await driver.read(talk, Span("holding", 0, 2))
    assert (refused.value.code, refused.value.refusal) == (f"{code:02X}", refusal)


async def test_a_gateways_exception_0b_leaves_a_write_unclear() -> None:
    driver = ModbusTcp()
    talk = hearing(driver, [framed(ModbusTcp, 1, bytes((0x86, 0x0B)))])
    with pytest.raises(NoReply):
        await driver.write(talk, Span("holding", 0, 1), [5])


@MODERATE
@given(st.sampled_from(KINDS), st.lists(st.binary(max_size=30), max_size=5), st.booleans())
async def test_whatever_comes_back_is_units_or_a_device_error(
    kind: type, heard: list[bytes], writing: bool
) -> None:
    driver, span = kind(station=1), Span("holding", 0, 2)
    bodies = [framed(kind, 1, piece[:20]) for piece in heard if piece]
    talk = hearing(driver, [piece for pair in zip(heard, bodies, strict=False) for piece in pair])
    with suppress(DeviceError):
        if writing:
            assert await driver.write(talk, span, [1, 2]) is True
        else:
            assert len(await driver.read(talk, span)) == 2


# ---- writing ---------------------------------------------------------------------------


async def test_a_write_is_acknowledged_by_its_own_address_and_value_only() -> None:
    driver, span = ModbusRtu(station=10), Span("holding", 0, 1)
    good = VECTORS["modbus-rtu-010"].frame
    others = [bytes((6, 0, 1, 0x12, 0x34)), bytes((16, 0, 0, 0, 1))]
    wrong = [framed(ModbusRtu, 10, body) for body in others]
    assert await driver.write(hearing(driver, [*wrong, good]), span, [0x1234]) is True
    with pytest.raises(NoReply):
        await driver.write(hearing(driver, wrong), span, [0x1234])
    less = framed(ModbusRtu, 10, bytes((6, 0, 0, 0x12, 0x33)))  # a drive that limits a set point
    with pytest.raises(Took) as caught:
        await driver.write(hearing(driver, [less]), span, [0x1234])
    assert caught.value.units == [0x1233]


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii, ModbusTcp])
async def test_bits_are_changed_by_function_22_as_the_standard_has_it(kind: type) -> None:
    """Application protocol V1.1b3, 6.16: register 5, AND 00F2h, OR 0025h."""
    driver, example = kind(station=1), bytes.fromhex("16 00 04 00 f2 00 25")
    talk = hearing(driver, [framed(kind, 1, example)])
    span, mask = Span("holding", 4, 1), 0xFF0D  # the bits that AND does not keep
    assert driver.changes_bits(span)
    assert await driver.change_bits(talk, span, mask, 0x25) is True
    assert talk.sent == [framed(kind, 1, example)]
    other = framed(kind, 1, bytes.fromhex("16 00 04 00 f2 00 24"), 2)
    with pytest.raises(NoReply):
        await driver.change_bits(hearing(driver, [other]), span, mask, 0x25)
    refused = framed(kind, 1, bytes.fromhex("96 01"), 3)
    with pytest.raises(Refused) as caught:
        await driver.change_bits(hearing(driver, [refused]), span, mask, 0x25)
    assert (caught.value.code, caught.value.unexecuted) == ("01", True)


def test_devices_whose_manuals_lack_function_22_are_not_asked() -> None:
    """Vigor B-5, LS 8.3 and EX485LNK 2.4 name their functions; no station answers a broadcast."""
    assert not ModbusRtu(station=1, addressing="vigor").changes_bits(Span("D", 7, 1))
    assert not ModbusRtu(station=1, addressing="k120s").changes_bits(Span("MW", 7, 1))
    assert not ModbusRtu(station=1, addressing="ex485lnk").changes_bits(Span("holding", 7, 1))
    assert not ModbusRtu(station=0).changes_bits(Span("holding", 7, 1))
    assert not ModbusRtu(station=1).changes_bits(Span("input", 7, 1))


async def test_vigor_may_forget_the_address_in_its_answer_to_function_06() -> None:
    forgetful = framed(ModbusRtu, 1, bytes((6, 0, 0, 0x12, 0x34)))
    other_value = framed(ModbusRtu, 1, bytes((6, 0, 0, 0x12, 0x35)))
    vigor, plain = ModbusRtu(station=1, addressing="vigor"), ModbusRtu(station=1)
    assert await vigor.write(hearing(vigor, [forgetful]), Span("D", 7, 1), [0x1234]) is True
    with pytest.raises(NoReply):
        await vigor.write(hearing(vigor, [other_value]), Span("D", 7, 1), [0x1234])
    with pytest.raises(NoReply):
        await plain.write(hearing(plain, [forgetful]), Span("holding", 7, 1), [0x1234])


@pytest.mark.parametrize("kind", [ModbusRtu, ModbusAscii])
async def test_a_broadcast_is_sent_without_waiting_for_a_reply(kind: type) -> None:
    driver = kind(station=0, addressing="ex485lnk")
    name = "modbus-rtu-005" if kind is ModbusRtu else "modbus-ascii-005"
    script, span = Script(driver, f"> {VECTORS[name].frame.hex()}"), Span("holding", 4, 2)
    assert await driver.write(script, span, [0x4321, 0x8765]) is False
    script.done()
    assert script.replies == []
    assert driver.write_cost(span) == Cost(len(VECTORS[name].frame), 0)


def test_a_broadcast_device_is_written_to_only() -> None:
    driver = ModbusRtu(station=0)
    assert driver.cost(Span("holding", 0, 1)) is None
    assert set(driver.areas) == {"holding", "coil"}
    assert not any(area.readable for area in driver.areas.values())


async def test_modbus_tcp_unit_0_answers() -> None:
    driver = ModbusTcp(station=0)
    talk = hearing(driver, [framed(ModbusTcp, 0, bytes((3, 2, 0, 7)))])
    assert list(await driver.read(talk, Span("holding", 0, 1))) == [7]


@pytest.mark.parametrize("order", ["low_first", "high_first"])
async def test_vigor_counters_from_c200_are_two_registers(order: Any) -> None:
    driver = ModbusRtu(station=1, addressing="vigor", counter_word_order=order)
    first, second = (0x5678, 0x1234) if order == "low_first" else (0x1234, 0x5678)
    answer = bytes((3, 4)) + first.to_bytes(2, "big") + second.to_bytes(2, "big")
    span = Span("C32", 200, 1)
    talk = hearing(driver, [framed(ModbusRtu, 1, answer)])
    assert list(await driver.read(talk, span)) == [0x12345678]
    assert talk.sent == [VECTORS["modbus-rtu-035"].frame]
    writing = hearing(driver, [framed(ModbusRtu, 1, bytes((16, 0x21, 0xC8, 0, 2)))])
    assert await driver.write(writing, span, [0x12345678]) is True
    assert writing.sent[0][7:11] == answer[2:]


@pytest.mark.parametrize("units", [[65536, 0], [-1, 0], [1], [1, 2, 3]])
async def test_units_that_do_not_fit_are_not_sent(units: list[int]) -> None:
    driver = ModbusRtu(station=1)
    with pytest.raises(BadValue):
        await driver.write(Script(driver), Span("holding", 0, 2), units)


# ---- resynchronising -------------------------------------------------------------------


@MODERATE
@given(
    st.sampled_from(KINDS),
    st.sampled_from(DIALECTS),
    st.integers(0, 10**6),
    st.data(),
)
async def test_a_resync_differs_from_the_outstanding_read_and_from_the_last_resync(
    kind: type, dialect: Any, salt: int, data: st.DataObject
) -> None:
    driver = kind(station=1, addressing=dialect)
    area = data.draw(st.sampled_from(sorted(driver.areas.values(), key=lambda a: a.name)))
    start = data.draw(st.integers(area.first, area.last))
    size = data.draw(st.integers(1, min(29, area.last - start + 1)))
    span = Span(area.name, start, size)
    cost = driver.cost(span)
    lengths = []
    for turn in (salt, salt + 2):
        talk = hearing(driver)
        with pytest.raises(NoReply):
            await driver.resync(talk, span, turn)
        lengths += talk.replies
    assert cost is not None
    assert len({cost.reply, *lengths}) == 3


async def test_after_an_exception_a_resync_reads_another_size() -> None:
    """And a second one says so: both may answer older questions."""
    driver, no = ModbusRtu(station=1), framed(ModbusRtu, 1, bytes((0x83, 2)))
    talk = hearing(driver, [no], [no])
    with pytest.raises(Refused):
        await driver.resync(talk, Span("holding", 65535, 1), 0)
    assert len(talk.replies) == len(set(talk.replies)) == 2


async def test_a_numbered_exception_is_believed() -> None:
    driver = ModbusTcp()
    talk = hearing(driver, [framed(ModbusTcp, 1, bytes((0x83, 2)))])
    await driver.resync(talk, None, 0)
    assert len(talk.sent) == 1


async def test_a_resync_by_diagnostics_takes_its_own_token_alone() -> None:
    driver = ModbusRtu(station=1, diagnostics=True)
    station = ModbusStation()
    await driver.resync(hearing(driver, lambda sent: station.hear(sent, 0.0)), None, 70000)
    earlier = framed(ModbusRtu, 1, bytes((8, 0, 0, 0, 41)))
    with pytest.raises(NoReply):
        await driver.resync(hearing(driver, [earlier]), None, 42)


async def test_a_resync_where_one_word_is_the_limit_asks_another_function() -> None:
    driver = ModbusRtu(station=1, max_read_words=1)
    talk = hearing(driver)
    with pytest.raises(NoReply):
        await driver.resync(talk, Span("holding", 5, 1), 0)
    assert talk.sent[0][1] != 3
