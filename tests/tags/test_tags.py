"""Tags: scale and offset, bits of words, limits of writing."""

import math
from decimal import Decimal
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gateway.errors import BadValue
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Quality, Reason, Tag, WriteRule, bad, good
from gateway.tags.shaping import Bounds
from gateway.tags.transfer import TransferRule
from gateway.values import Kind, Layout, Order, Value, ValueType, parse_type
from tests.tag_settings import grouped


def tag(kind: str = "int16", unit: Unit = Unit.WORD, bit: int | None = None, **more: Any) -> Tag:
    layout = Layout(parse_type(kind))
    size = layout.type.words // 2 if unit is Unit.DWORD else layout.type.words
    return Tag(
        device="mixer",
        name="speed",
        text="D100",
        address=Address("D", 100, bit),
        span=Span("D", 100, size),
        unit_kind=unit,
        layout=layout,
        **grouped(**more),
    )


def test_a_tag_is_known_by_device_and_name() -> None:
    assert tag().key == "mixer/speed"


@pytest.mark.parametrize(
    ("raw", "scale", "offset", "value"),
    [
        (123, 0.1, 0.0, 12.3),  # and not 12.3000000000000007
        (3, 0.1, 0.0, 0.3),
        (7, 0.01, 0.0, 0.07),
        (1, 1e-05, 0.0, 1e-05),
        (5, 2.0, 0.0, 10.0),
        (4000, 0.025, -20.0, 80.0),
        (1, 1.0, 0.1, 1.1),
        (0xFFFF, 0.1, 0.0, -0.1),
        (0, 0.1, -273.15, -273.15),
        (10, -0.5, 3.0, -2.0),
    ],
)
def test_scaled_values_have_the_decimals_a_person_would_write(
    raw: int, scale: float, offset: float, value: float
) -> None:
    scaled = tag(scale=scale, offset=offset)
    assert scaled.decode([raw]) == value
    assert scaled.encode(value) == [raw]


def test_a_scale_of_one_leaves_whole_numbers_whole() -> None:
    assert type(tag().decode([5])) is int


@given(
    st.integers(-(2**15), 2**15 - 1),
    st.integers(1, 10**6).map(lambda n: n / 1000),
    st.integers(-(10**6), 10**6).map(lambda n: n / 100),
)
def test_scaled_whole_numbers_survive_the_round_trip(raw: int, scale: float, offset: float) -> None:
    scaled = tag(scale=scale, offset=offset)
    units = [raw & 0xFFFF]
    value = scaled.decode(units)
    assert value is not None
    assert scaled.encode(value) == units
    assert scaled.from_units(units) == value


@given(st.integers(0, 2**32 - 1), st.sampled_from(["int32", "uint32", "float32", "bcd32"]))
def test_double_words_survive_the_round_trip(raw: int, kind: str) -> None:
    counter = tag(kind, Unit.DWORD)
    value = counter.decode([raw])
    assume(value is not None)
    assert value is not None
    units = counter.encode(value)
    assert counter.decode(units) == value
    if kind != "float32":  # zero has two signs there
        assert units == [raw]


def test_a_double_word_is_read_as_a_whole() -> None:
    assert tag("int32", Unit.DWORD).decode([0x12345678]) == 0x12345678
    assert tag("int32", Unit.DWORD).decode([0xFFFFFFFF]) == -1
    assert tag("int32", Unit.DWORD).encode(-2) == [0xFFFFFFFE]
    assert tag("uint32", Unit.DWORD, scale=0.1).decode([0xFFFFFFFF]) == 429496729.5


@given(st.integers(0, 0xFFFF), st.integers(0, 15))
def test_a_bit_of_a_word(word: int, bit: int) -> None:
    valve = tag("bool", bit=bit)
    assert valve.decode([word]) is bool(word & (1 << bit))


@pytest.mark.parametrize("value", [True, False])
def test_writing_a_bit_of_a_word_gives_the_bit_alone(value: bool) -> None:
    valve = tag("bool", bit=3)
    assert valve.encode(value) == [int(value)]
    assert valve.from_units([int(value)]) is value


def test_a_bit_device_is_a_boolean() -> None:
    door = tag("bool", Unit.BIT)
    assert door.decode([1]) is True
    assert door.decode([0]) is False
    assert door.encode(True) == [1]


def test_words_without_a_value_stay_none_when_scaled() -> None:
    assert tag("float32", scale=0.1).decode([0, 0x7FC0]) is None
    assert tag("bcd16", scale=0.1).decode([0xFFFF]) is None


def test_a_scale_does_not_touch_texts_and_bits() -> None:
    assert tag("string[2]", scale=2.0, offset=1.0).decode([0x4142]) == "AB"
    assert tag("bool", Unit.BIT, scale=2.0, offset=1.0).decode([1]) is True


def test_a_value_that_its_scale_makes_infinite_is_none() -> None:
    most = tag("float64").encode(1.7e308)
    assert tag("float64", scale=10.0).decode(most) is None
    assert tag("uint16", scale=1e308).decode([0xFFFF]) is None


@given(st.integers(0, 2**64 - 1), st.floats(allow_nan=False, allow_infinity=False).filter(bool))
def test_a_decoded_value_is_finite_or_none(raw: int, scale: float) -> None:
    words = [raw >> shift & 0xFFFF for shift in (0, 16, 32, 48)]
    for kind in ("int64", "float64"):
        value = tag(kind, scale=scale).decode(words)
        assert value is None or (isinstance(value, (int, float)) and math.isfinite(value))


@given(
    st.sampled_from([k.value for k in Kind if k is not Kind.STRING] + ["string[4]"]),
    st.one_of(
        st.booleans(),
        st.integers(),
        st.integers(-(10**400), 10**400),
        st.floats(),
        st.text(max_size=5),
    ),
    st.floats(allow_nan=False, allow_infinity=False).filter(bool),
    st.floats(allow_nan=False, allow_infinity=False),
)
def test_any_value_becomes_words_or_is_refused(
    kind: str, value: Value, scale: float, offset: float
) -> None:
    for one in (tag(kind), tag(kind, scale=scale, offset=offset)):
        try:
            units = one.encode(value)
        except BadValue:
            continue
        assert len(units) == one.span.size
        assert all(0 <= unit <= 0xFFFF for unit in units)


def test_a_number_of_thousands_of_digits_is_refused() -> None:
    for kind in ("int16", "bcd16", "float64", "bool"):
        with pytest.raises(BadValue):
            tag(kind).encode(10**5000)
        with pytest.raises(BadValue):
            tag(kind, write=WriteRule(max=1)).encode(10**5000)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (0, "0 is below the least value 1"),
        (41, "41 is above the greatest value 40"),
        (40.5, "40.5 is above the greatest value 40"),
        (0.5, "0.5 is below the least value 1"),
        (math.nan, "nan is not a whole number"),
        (math.inf, "inf is above the greatest value 40"),
    ],
)
def test_a_value_outside_the_limits_is_refused(value: float, says: str) -> None:
    recipe = tag(write=WriteRule(min=1, max=40))
    with pytest.raises(BadValue) as caught:
        recipe.encode(value)
    assert str(caught.value) == says


def test_the_limits_themselves_are_allowed() -> None:
    recipe = tag(write=WriteRule(min=1, max=40))
    assert [recipe.encode(value) for value in (1, 40, 1.0, 40.0)] == [[1], [40], [1], [40]]


def test_the_limits_are_printed_with_all_their_digits() -> None:
    with pytest.raises(BadValue, match=r"greatest value 1234567\.5$"):
        tag("int32", write=WriteRule(max=1234567.5)).encode(2000000)


def test_limits_are_in_the_tags_own_units() -> None:
    setpoint = tag(scale=0.1, write=WriteRule(min=20, max=250))
    assert setpoint.encode(250) == [2500]
    with pytest.raises(BadValue):
        setpoint.encode(250.1)


def test_rounding_to_the_devices_steps_does_not_pass_a_limit() -> None:
    setpoint = tag(scale=0.1, write=WriteRule(min=-1.35, max=1.35))
    for value in (1.35, -1.35):
        with pytest.raises(BadValue, match="the device holds"):
            setpoint.encode(value)
    assert setpoint.encode(1.34) == [13]


@pytest.mark.parametrize(
    ("kind", "scale"), [("int16", 0.1), ("int16", 0.3), ("float32", 0.1), ("float32", 1.0)]
)
def test_limits_and_clamps_are_decimals_and_so_is_what_a_transfer_carries(
    kind: str, scale: float
) -> None:
    """0.3 is the limit 0.3, although 3 x 0.1 is more than 0.3 in floats."""
    step = Decimal(repr(scale)) if kind == "int16" else Decimal("0.1")
    carries = TransferRule(number=1, source="a/x", target="b/y", text=("a/x", "b/y"), scale=0.1)
    for number in range(-120, 121):
        value, tenth = float(step * number), float(step * number / 10)
        only = tag(kind, scale=scale, write=WriteRule(min=value, max=value))
        units = only.encode(value)
        assert only.from_units(units) == value
        assert carries.value(value, whole=False) == tenth
        assert tag("float64", write=WriteRule(min=tenth, max=tenth)).encode(tenth)
        for clamp in (Bounds(high=value), Bounds(low=value)):
            clamped = tag(kind, scale=scale, clamp=clamp, range=clamp, write=WriteRule())
            assert clamped.encode(value) == units
            assert clamped.from_units(units) == value
            assert not clamp.exclude(value)


@given(
    st.sampled_from([0.1, 0.25, 0.3, 2.0, 7.0]),
    st.floats(-100, 100),
    st.floats(-100, 100),
    st.floats(-200, 200),
)
def test_the_sent_value_keeps_the_limits(
    scale: float, one: float, other: float, value: float
) -> None:
    low, high = min(one, other), max(one, other)
    limited = tag(scale=scale, write=WriteRule(min=low, max=high))
    try:
        units = limited.encode(value)
    except BadValue:
        return
    real = limited.from_units(units)
    assert isinstance(real, (int, float))
    assert low <= real <= high
    assert abs(real - value) <= scale / 2 + 1e-9


def test_a_float_limit_that_float32_cannot_hold_exactly_can_be_written() -> None:
    level = tag("float32", write=WriteRule(min=0.1, max=0.7))
    assert level.from_units(level.encode(0.1)) == pytest.approx(0.1)
    assert level.from_units(level.encode(0.7)) == pytest.approx(0.7)


@pytest.mark.parametrize("value", ["5", True])
def test_limits_do_not_let_other_types_through(value: Value) -> None:
    with pytest.raises(BadValue, match="is not a number"):
        tag(write=WriteRule(min=0, max=9)).encode(value)


def test_tags_of_one_kind_share_their_decoder() -> None:
    assert tag(scale=0.1).convert is tag(scale=0.1).convert
    assert tag(scale=0.1).decode is not tag(scale=0.2).decode
    swapped = Layout(ValueType(Kind.INT16), Order.LOW_FIRST, Order.LOW_FIRST)
    assert tag().decode([0x0100]) == 256
    assert (
        Tag(
            device="a",
            name="b",
            text="D1",
            address=Address("D", 1),
            span=Span("D", 1, 1),
            unit_kind=Unit.WORD,
            layout=swapped,
        ).decode([0x0100])
        == 1
    )


def test_a_sample_is_good_with_a_value_or_bad_with_a_reason() -> None:
    speed = tag()
    known = good(speed, 5, 7)
    assert (known.value, known.quality, known.time, known.reason) == (5, Quality.GOOD, 7, None)
    unknown = bad(speed, Reason.NO_REPLY, 8, "no reply for 2 s")
    assert (unknown.value, unknown.quality, unknown.reason) == (None, Quality.BAD, "no-reply")
    assert unknown.detail == "no reply for 2 s"
