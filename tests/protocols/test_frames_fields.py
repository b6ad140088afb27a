"""Fields: what is taken out of a frame, what is put into one, and what neither can be."""

import struct
from contextlib import suppress
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import BadValue, ConfigError, Garbled
from gateway.protocols.frames import Field
from gateway.values.numerals import Scalar
from tests.vectors import vectors

BY_ID = {v.id: v for v in vectors("noproto-vb1com", "noproto-k120s", "vigor")}
K120S_WEIGHING = BY_ID["noproto-k120s-001"].frame
VIGOR_REPLY = BY_ID["noproto-vb1com-019"].frame  # D0 = 1234h, as hex characters from offset 7

RAW = [
    ("uint8", 0, 255),
    ("int8", -128, 127),
    ("uint16", 0, 0xFFFF),
    ("int16", -0x8000, 0x7FFF),
    ("uint32", 0, 2**32 - 1),
    ("int32", -(2**31), 2**31 - 1),
    ("uint64", 0, 2**64 - 1),
    ("int64", -(2**63), 2**63 - 1),
    ("bcd8", 0, 99),
    ("bcd16", 0, 9999),
    ("bcd32", 0, 99999999),
]


def test_a_word_by_offset_low_byte_first() -> None:
    field = Field(type="uint16", offset=2, byte_order="low_first")
    assert field.take(field.cut(K120S_WEIGHING)) == 0x3412


def test_a_word_by_offset_high_byte_first() -> None:
    field = Field(type="uint16", offset=2, byte_order="high_first")
    assert field.take(field.cut(K120S_WEIGHING)) == 0x1234


def test_a_word_as_hex_text_by_offset_or_by_columns() -> None:
    for place in ({"offset": 7}, {"columns": "8-11"}):
        field = Field(type="int16", hex=True, byte_order="low_first", **place)
        assert field.take(field.cut(VIGOR_REPLY)) == 0x1234


@pytest.mark.parametrize(("kind", "least", "most"), RAW)
@pytest.mark.parametrize("order", ["low_first", "high_first"])
@pytest.mark.parametrize("as_hex", [False, True])
def test_raw_numbers_come_back_as_they_were_put(
    kind: str, least: int, most: int, order: str, as_hex: bool
) -> None:
    field = Field(type=kind, byte_order=order, hex=as_hex)  # type: ignore[arg-type]
    for value in (least, 0, 1, 12, most):
        raw = field.put(value)
        assert len(raw) == field.size
        assert field.take(raw) == value
    for value in (least - 1, most + 1):
        with pytest.raises(BadValue, match="does not fit"):
            field.put(value)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_float_comes_back_as_it_was_put(value: float) -> None:
    field = Field(type="float32", byte_order="low_first")
    assert field.put(value) == struct.pack("<f", value)
    taken = field.take(field.put(value))
    assert isinstance(taken, float)
    assert struct.pack("<f", taken) == struct.pack("<f", value)


@given(st.integers(-999, 9999), st.integers(0, 99))
def test_a_decimal_comes_back_as_it_was_put(whole: int, hundredths: int) -> None:
    value = float(f"{whole}.{hundredths:02d}")
    for point in (".", ","):
        field = Field(type="decimal", format="08.2f", decimal_point=point)
        raw = field.put(value)
        assert len(raw) == 8
        assert field.take(raw) == value


@pytest.mark.parametrize(
    ("field", "value", "raw"),
    [
        (Field(type="decimal", format="06.2f"), 25, b"025.00"),
        (Field(type="decimal", format="+8.1f"), -12.34, b"   -12.3"),
        (Field(type="decimal", format=".1f"), -0.04, b"0.0"),
        (Field(type="decimal", format="06.2f", decimal_point=","), 2.5, b"002,50"),
        (Field(type="integer"), 42, b"42"),
        (Field(type="integer", format="04d"), 7.0, b"0007"),
        (Field(type="text"), "AB 1", b"AB 1"),
        (Field(type="text", encoding="latin-1"), "Ä", b"\xc4"),
    ],
)
def test_values_are_written_in_their_format(field: Field, value: Scalar, raw: bytes) -> None:
    assert field.put(value) == raw


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (Field(type="decimal", format="06.2f"), 1000),
        (Field(type="decimal", format="06.2f"), -100),
        (Field(type="decimal", format="06.2f"), float("nan")),
        (Field(type="decimal", format="06.2f"), 10**400),
        (Field(type="decimal", format="06.2f"), "12"),
        (Field(type="decimal", format="06.2f"), True),
        (Field(type="integer", format="03d"), 1000),
        (Field(type="integer"), 1.5),
        (Field(type="integer"), float("inf")),
        (Field(type="uint8"), "1"),
        (Field(type="uint8"), 1.5),
        (Field(type="float32", byte_order="low_first"), 1e39),
        (Field(type="float32", byte_order="low_first"), float("nan")),
        (Field(type="uint8", bit=1), True),
        (Field(type="text"), 12),
        (Field(type="text"), "Ä"),
        (Field(type="text"), "A\rRESET"),
    ],
)
def test_a_value_that_cannot_be_written_in_full_is_refused(field: Field, value: Scalar) -> None:
    with pytest.raises(BadValue):
        field.put(value)


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        (b"+001234.5", 1234.5),
        (b"  -12.50 ", -12.5),
        (b"-   12.50", -12.5),
        (b"12.", 12.0),
        (b".5", 0.5),
        (b"007", 7.0),
    ],
)
def test_decimals_as_devices_write_them(raw: bytes, value: float) -> None:
    assert Field(type="decimal").take(raw) == value


@pytest.mark.parametrize(
    "raw",
    [
        *(b"", b"   ", b"+", b".", b"1_0", b"1e5", b"nan", b"inf", b"1 2", b"12,5", b"0x1F"),
        *(b"--1", b"1.2.3", b"12kg", b"9" * 19, b"\xb2", b"+9999.9\x00", b"1\n"),
    ],
)
def test_a_text_that_is_no_number_is_garbled(raw: bytes) -> None:
    for field in (Field(type="decimal"), Field(type="integer")):
        with pytest.raises(Garbled):
            field.take(raw)


def test_a_decimal_comma_needs_its_setting_and_a_thousands_point_is_no_number() -> None:
    comma = Field(type="decimal", decimal_point=",")
    assert comma.take(b"1,25") == 1.25
    for raw in (b"1.25", b"1.000,5"):
        with pytest.raises(Garbled):
            comma.take(raw)


def test_an_integer_has_no_point() -> None:
    assert Field(type="integer").take(b" -12") == -12
    with pytest.raises(Garbled):
        Field(type="integer").take(b"12.0")


@pytest.mark.parametrize(
    ("field", "raw"),
    [
        (Field(type="uint16", byte_order="low_first"), b"\x01"),
        (Field(type="uint16", byte_order="low_first", hex=True), b"12G4"),
        (Field(type="uint16", byte_order="low_first", hex=True), b"123"),
        (Field(type="bcd8"), b"\x1a"),
        (Field(type="float32", byte_order="high_first"), struct.pack(">f", float("nan"))),
        (Field(type="float64", byte_order="high_first"), struct.pack(">d", float("inf"))),
        (Field(type="text"), b"\xff"),
        (Field(type="text", encoding="utf-8"), b"\xc4"),
    ],
)
def test_bytes_that_are_no_such_value_are_garbled(field: Field, raw: bytes) -> None:
    with pytest.raises(Garbled) as caught:
        field.take(raw)
    assert caught.value.data == raw


def test_a_frame_too_short_for_its_field_is_garbled() -> None:
    for field in (Field(type="text", columns="3-6"), Field(type="uint8", offset=5)):
        with pytest.raises(Garbled, match="5 bytes, not 6"):
            field.cut(K120S_WEIGHING)


def test_one_bit_of_a_number() -> None:
    bits = [Field(type="uint8", bit=bit).take(b"\x05") for bit in range(8)]
    assert bits == [True, False, True, False, False, False, False, False]


def test_a_text_by_columns_loses_its_padding_and_a_group_keeps_its_spaces() -> None:
    assert Field(type="text", columns="1-4").take(b"AB  ") == "AB"
    assert Field(type="text").take(b"AB  ") == "AB  "


@given(st.sampled_from(["decimal", "integer", "text", "uint16", "bcd16", "float32"]), st.binary())
def test_any_bytes_give_a_value_or_garbled(kind: str, raw: bytes) -> None:
    order = None if kind in ("decimal", "integer", "text") else "low_first"
    with suppress(Garbled):
        value = Field(type=kind, byte_order=order).take(raw)  # type: ignore[arg-type]
        assert isinstance(value, str if kind == "text" else (int, float))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"type": "uint16", "offset": 0}, "byte_order: low_first or high_first"),
        ({"type": "uint8", "offset": -1}, "0 or more"),
        ({"type": "uint8", "offset": 0, "columns": "1-1"}, "one place"),
        ({"type": "text", "offset": 0}, "write columns"),
        ({"type": "text", "columns": "0-4"}, "such as 7-14"),
        ({"type": "text", "columns": "4-3"}, "such as 7-14"),
        ({"type": "text", "columns": "4"}, "such as 7-14"),
        ({"type": "uint16", "byte_order": "low_first", "columns": "1-4"}, "takes 2"),
        ({"type": "text", "byte_order": "low_first"}, "has no byte_order"),
        ({"type": "decimal", "bit": 1}, "has no bit"),
        ({"type": "uint8", "bit": 8}, "no bit 8"),
        ({"type": "int8", "bit": 0}, "unsigned"),
        ({"type": "decimal", "hex": True}, "use it with uint16"),
        ({"type": "text", "decimal_point": ","}, "belongs to decimal"),
        ({"type": "decimal", "encoding": "utf-8"}, "belongs to text"),
        ({"type": "uint8", "format": "03d"}, "belongs to integer and decimal"),
        ({"type": "decimal", "format": "03d"}, "write it like 06.2f"),
        ({"type": "integer", "format": "6.2f"}, "write it like 04d"),
        ({"type": "decimal", "format": "{}"}, "write it like 06.2f"),
    ],
)
def test_a_field_that_cannot_be_is_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Field(**settings)  # type: ignore[arg-type]  # mistakes are the point


@pytest.mark.parametrize(("half", "value"), [("low", 0x34), ("high", 0x12)])
def test_a_byte_of_a_word(half: Literal["low", "high"], value: int) -> None:
    word = Field(type="uint16", byte_order="high_first", byte=half)
    assert word.take(b"\x12\x34") == value
    with pytest.raises(BadValue, match="a part of a number"):
        word.put(1)


@pytest.mark.parametrize("settings", [{"type": "int16"}, {"type": "uint16", "bit": 3}])
def test_a_byte_is_half_of_a_whole_uint16(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="low or high half of a uint16"):
        Field(byte_order="low_first", byte="low", **settings)
