"""Words and bits, and the values people read."""

import math
import struct
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import BadValue, ConfigError
from gateway.values import (
    Kind,
    Layout,
    Order,
    ValueType,
    from_words,
    parse_type,
    swapped,
    to_words,
)
from gateway.values.numerals import Scalar, are_apart, as_decimal

LOW, HIGH = Order.LOW_FIRST, Order.HIGH_FIRST
INTEGERS = {
    Kind.INT16: (-(2**15), 2**15 - 1),
    Kind.UINT16: (0, 2**16 - 1),
    Kind.INT32: (-(2**31), 2**31 - 1),
    Kind.UINT32: (0, 2**32 - 1),
    Kind.INT64: (-(2**63), 2**63 - 1),
    Kind.UINT64: (0, 2**64 - 1),
    Kind.BCD16: (0, 9999),
    Kind.BCD32: (0, 99999999),
}
orders = st.sampled_from(Order)
# Each kind with one of its values: what `to_words` takes and `from_words` gives back.
numbers = st.sampled_from(list(INTEGERS)).flatmap(
    lambda kind: st.tuples(st.just(kind), st.integers(*INTEGERS[kind]))
)


def layout(kind: str, words: Order = LOW, octets: Order = HIGH) -> Layout:
    return Layout(parse_type(kind), words, octets)


@pytest.mark.parametrize(
    ("text", "words"),
    [("bool", 1), ("int16", 1), ("bcd16", 1), ("float32", 2), ("bcd32", 2), ("int64", 4),
     ("float64", 4), ("string[1]", 1), ("string[16]", 8), ("string[17]", 9), ("string[250]", 125),
     ("telephone", 6)],
)  # fmt: skip
def test_the_number_of_words_of_a_type(text: str, words: int) -> None:
    kind = parse_type(text)
    assert kind.words == words
    assert str(kind) == text


@pytest.mark.parametrize(
    "text",
    ["", "int", "INT16", " int16", "string", "string[]", "string[0]", "string[251]",
     "string[-1]", "telephone[2]", "string[١]", "string[16]\n", "int16\n"],
)  # fmt: skip
def test_invalid_types_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_type(text)


WORKED: list[tuple[Layout, list[int], Scalar]] = [
    (layout("bool"), [1], True),
    (layout("bool"), [0], False),
    (layout("int16"), [0x7FFF], 32767),
    (layout("int16"), [0x8000], -32768),
    (layout("int16"), [0xFFFF], -1),
    (layout("int16", octets=LOW), [0xFFFE], -257),
    (layout("uint16"), [0x8000], 32768),
    (layout("uint16", octets=LOW), [0x1234], 0x3412),
    (layout("int32"), [0x5678, 0x1234], 0x12345678),
    (layout("int32", HIGH), [0x1234, 0x5678], 0x12345678),
    (layout("int32", HIGH, LOW), [0x3412, 0x7856], 0x12345678),
    (layout("int32", LOW, LOW), [0x7856, 0x3412], 0x12345678),
    (layout("int32"), [0xFFFF, 0xFFFF], -1),
    (layout("uint32"), [0xFFFF, 0xFFFF], 2**32 - 1),
    (layout("int64"), [4, 3, 2, 1], 0x0001_0002_0003_0004),
    (layout("uint64", HIGH), [1, 2, 3, 4], 0x0001_0002_0003_0004),
    (layout("float32"), [0x0000, 0x3F80], 1.0),
    (layout("float32", HIGH), [0xC148, 0x0000], -12.5),
    (layout("float64", HIGH), [0x4009, 0x21FB, 0x5444, 0x2D18], math.pi),
    (layout("bcd16"), [0x1234], 1234),
    (layout("bcd16", octets=LOW), [0x3412], 1234),
    (layout("bcd32"), [0x5678, 0x1234], 12345678),
    (layout("bcd32", HIGH), [0x0000, 0x0042], 42),
    (layout("string[4]"), [0x4142, 0x4344], "ABCD"),
    (layout("string[4]", octets=LOW), [0x4142, 0x4344], "BADC"),
    (layout("string[3]"), [0x4142, 0x4300], "ABC"),
    (layout("string[4]"), [0x4142, 0x0000], "AB"),
    (layout("string[2]"), [0xE4B0], "ä°"),
    (layout("string[2]"), [0x0000], ""),
    # VB/VH manual, B-3-8, program of the PLC on the right; and 2620-4393 as its picture has it
    (layout("telephone"), [0x0262, 0x6794, 0xE, 0, 0, 0], "2620-4976"),
    (layout("telephone", HIGH), [0x0262, 0x3934, 0xE, 0, 0, 0], "2620-4393"),
    (layout("telephone"), [0x0262, 0x6794, 0xE0, 0, 0, 0], "2620-4976-0"),
    (layout("telephone"), [0xE, 0, 0, 0, 0, 0], ""),
    (layout("telephone"), [0x4321] * 6, "1234-1234-1234-1234-1234-1234"),
]


@pytest.mark.parametrize(("how", "words", "value"), WORKED, ids=lambda x: str(x)[:60])
def test_worked_values_both_ways(how: Layout, words: list[int], value: Scalar) -> None:
    read = from_words(how)(words)
    assert read == value
    assert type(read) is type(value)
    assert to_words(how)(value) == words


def test_the_word_order_of_a_text_is_always_that_of_its_addresses() -> None:
    for order in Order:
        assert from_words(layout("string[4]", order))([0x4142, 0x4344]) == "ABCD"


def test_a_text_ends_at_its_first_nul() -> None:
    assert from_words(layout("string[6]"))([0x4142, 0x0043, 0x4445]) == "AB"


def test_a_text_of_odd_length_is_not_read_past_its_end() -> None:
    assert from_words(layout("string[3]"))([0x4142, 0x4344]) == "ABC"


@pytest.mark.parametrize("raw", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_nan_and_infinity_give_none(kind: str, raw: float) -> None:
    octets = struct.pack(">f" if kind == "float32" else ">d", raw)
    words = struct.unpack(f">{len(octets) // 2}H", octets)
    assert from_words(layout(kind, HIGH))(words) is None


@pytest.mark.parametrize("word", [0x000A, 0xA000, 0x12F4, 0xFFFF])
def test_bcd_with_a_digit_above_9_gives_none(word: int) -> None:
    assert from_words(layout("bcd16"))([word]) is None
    assert from_words(layout("bcd32"))([0x1234, word]) is None
    assert from_words(layout("bcd32"))([word, 0x1234]) is None


@given(numbers, orders, orders)
def test_whole_numbers_survive_the_round_trip(
    number: tuple[Kind, int], words: Order, octets: Order
) -> None:
    kind, value = number
    how = Layout(ValueType(kind), words, octets)
    encoded = to_words(how)(value)
    assert len(encoded) == how.type.words
    assert all(0 <= word <= 0xFFFF for word in encoded)
    assert from_words(how)(encoded) == value


@given(st.floats(allow_nan=False, allow_infinity=False), orders, orders)
def test_float64_survives_the_round_trip(value: float, words: Order, octets: Order) -> None:
    how = Layout(ValueType(Kind.FLOAT64), words, octets)
    assert from_words(how)(to_words(how)(value)) == value


@given(st.floats(allow_nan=False, allow_infinity=False, width=32), orders, orders)
def test_float32_comes_back_as_the_same_float32(value: float, words: Order, octets: Order) -> None:
    how = Layout(ValueType(Kind.FLOAT32), words, octets)
    encoded = to_words(how)(value)
    read = from_words(how)(encoded)
    assert isinstance(read, float)
    assert struct.pack(">f", read) == struct.pack(">f", value)
    assert to_words(how)(read) == encoded


@given(st.text(st.characters(min_codepoint=1, max_codepoint=255), max_size=9), orders)
def test_texts_survive_the_round_trip(value: str, octets: Order) -> None:
    how = layout("string[9]", octets=octets)
    assert from_words(how)(to_words(how)(value)) == value


@given(
    st.sampled_from([kind.value for kind in Kind if kind is not Kind.STRING] + ["string[7]"]),
    st.data(),
    orders,
    orders,
)
def test_any_value_that_was_read_can_be_written_back(
    kind: str, data: st.DataObject, words: Order, octets: Order
) -> None:
    how = layout(kind, words, octets)
    size = how.type.words
    raw = data.draw(st.lists(st.integers(0, 0xFFFF), min_size=size, max_size=size))
    value = from_words(how)(raw)
    if value is not None:
        assert from_words(how)(to_words(how)(value)) == value


@pytest.mark.parametrize("kind", list(INTEGERS))
def test_values_one_beyond_the_bounds_are_refused(kind: Kind) -> None:
    low, high = INTEGERS[kind]
    for value in (low - 1, high + 1, 10**300, -(10**300)):
        with pytest.raises(BadValue, match=f"does not fit.*{low} to {high}"):
            to_words(Layout(ValueType(kind)))(value)


@pytest.mark.parametrize("kind", list(INTEGERS))
@pytest.mark.parametrize("value", [0.5, math.nan, math.inf, True, False, "1", ""])
def test_values_without_a_whole_number_are_refused(kind: Kind, value: Scalar) -> None:
    with pytest.raises(BadValue):
        to_words(Layout(ValueType(kind)))(value)


def test_a_float_that_is_whole_is_a_whole_number() -> None:
    assert to_words(layout("int16"))(12.0) == [12]


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 10**400, True, "1.5"])
def test_values_without_a_finite_number_are_refused(kind: str, value: Scalar) -> None:
    with pytest.raises(BadValue):
        to_words(layout(kind))(value)


def test_values_too_large_for_float32_are_refused() -> None:
    with pytest.raises(BadValue, match=r"does not fit float32 \(up to 3\.4e38 either way\)"):
        to_words(layout("float32"))(1e39)


@pytest.mark.parametrize("value", [2, -1, 0.5, math.nan, "true", "1"])
def test_values_other_than_true_and_false_are_refused(value: Scalar) -> None:
    with pytest.raises(BadValue, match="neither true nor false"):
        to_words(layout("bool"))(value)


@pytest.mark.parametrize("value", [0, 1, 0.0, 1.0, True, False])
def test_zero_and_one_are_booleans(value: Scalar) -> None:
    assert to_words(layout("bool"))(value) == [int(value)]


@pytest.mark.parametrize("value", ["ABCDE", "€", "A\0", 5, True])
def test_values_other_than_four_characters_are_refused(value: Scalar) -> None:
    with pytest.raises(BadValue):
        to_words(layout("string[4]"))(value)


def test_a_shorter_text_clears_the_rest() -> None:
    assert to_words(layout("string[4]"))("A") == [0x4100, 0]


@given(st.integers(0, 0xFFFF))
def test_swapping_twice_changes_nothing(word: int) -> None:
    assert swapped(swapped(word)) == word
    assert swapped(word) == int.from_bytes(word.to_bytes(2, "big"), "little")


# Numbers as plants have them: a few digits, of any size.
NUMBERS = st.builds(
    lambda digits, places: digits / 10**places, st.integers(-(10**6), 10**6), st.integers(0, 9)
)


@given(NUMBERS | st.integers(-(2**63), 2**64), NUMBERS | st.floats(-1e15, 1e15), st.booleans())
def test_a_distance_is_that_of_the_decimals(one: float, least: float, up: bool) -> None:
    """Also of numbers that differ by exactly this distance, and by a digit more or less."""
    for digit in (-1, 0, 1):
        exact = abs(Fraction(repr(least))) + digit * Fraction(1, 10**6)
        other = float(Fraction(repr(one)) + (exact if up else -exact))
        real = abs(Fraction(repr(other)) - Fraction(repr(one)))
        assert are_apart(one, other, abs(least)) is (real >= abs(Fraction(repr(least))))


@given(NUMBERS, st.integers(1, 100))
def test_a_percentage_is_that_of_the_first_number(one: float, percent: int) -> None:
    other = float(as_decimal(one) + as_decimal(abs(one)) * percent / 100)
    assert are_apart(one, other, percent, percent=True)
    assert are_apart(one, other, percent + 0.001, percent=True) is (one == 0)
