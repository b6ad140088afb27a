"""Integers with scale and offset: no digit is lost that a JSON number carries."""

from decimal import Decimal
from fractions import Fraction

import orjson
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from gateway.config.settings.parsers import every_digit
from gateway.errors import BadValue, ConfigError
from gateway.protocols.driver import Unit
from gateway.tags import Tag
from gateway.tags.scaling import Linear, exact_below, linear
from gateway.values import parse_type
from tests.tags.test_tags import tag

KINDS = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
    "bcd16": (0, 10**4 - 1),
    "bcd32": (0, 10**8 - 1),
}
DECIMALS = st.decimals(allow_nan=False, allow_infinity=False, places=6).map(float)
SCALES = st.one_of(
    st.integers(-1000, 1000),
    st.sampled_from([0.1, 0.01, 0.001, 0.025, -0.5, 1e-9, 1e9, 3e-05]),
    DECIMALS,
).filter(lambda scale: scale != 0 and abs(scale) < 1e15)
OFFSETS = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0.5, -273.15, 0.001]),
    DECIMALS.filter(lambda offset: abs(offset) < 1e15),
)


@st.composite
def held(draw: st.DrawFn) -> tuple[str, int]:
    """An integer type and an integer that it holds, often at the end of its range."""
    kind = draw(st.sampled_from(sorted(KINDS)))
    low, high = KINDS[kind]
    return kind, draw(st.one_of(st.integers(low, high), st.sampled_from([low, high, high - 1])))


def units_of(kind: str, raw: int) -> list[int]:
    return tag(kind).encode(raw)


@example(("int64", 2**53 + 1), 1, 5)
@example(("uint64", 2**64 - 6), 1, 5)
@example(("uint32", 2**32 - 1), 0.1, 0)
@given(held(), SCALES, OFFSETS)
def test_a_written_value_is_the_integer_that_was_read(
    integer: tuple[str, int], scale: float, offset: float
) -> None:
    kind, raw = integer
    scaled = tag(kind, scale=scale, offset=offset)
    units = units_of(kind, raw)
    value = orjson.loads(orjson.dumps(scaled.decode(units)))
    assert value is not None
    exact = raw * Fraction(repr(scale)) + Fraction(repr(offset))
    if isinstance(value, int):
        assert value == exact
    else:
        assert value == exact.numerator / exact.denominator  # Python divides integers exactly
    limit = scaled.exact_below
    assume(limit is None or abs(exact) < limit)
    assert scaled.encode(value) == units


@pytest.mark.parametrize(
    ("kind", "scale", "offset", "limit"),
    [
        ("int64", 1, 0, None),
        ("int64", 1, 5, None),
        ("int64", 1, -5, 2.0**63),
        ("uint64", 10, 0, 2.0**64),
        ("uint32", 1e10, 0, None),  # beyond 64 bits, but its steps are wide
        ("uint32", 0.001, 0, None),
        ("int64", 0.5, 0, 2.0**50),
        ("int64", 0.75, 0, 2.0**51),
        ("int32", 0.1, 1e15, 2.0**48),
    ],
)
def test_the_limit_of_a_json_number(
    kind: str, scale: float, offset: float, limit: float | None
) -> None:
    line = linear(scale, offset) or Linear(Fraction(1), Fraction(0))
    assert exact_below(parse_type(kind), line) == limit


@pytest.mark.parametrize(
    ("kind", "scale", "offset", "type_"),
    [
        ("bcd16", 5, 0, "uint16"),  # 9999 x 5
        ("bcd16", 1, 55_537, "int32"),  # 65536
        ("int8", 100, 0, "int32"),  # -12800 to 12700
        ("int16", -1, 0, "int32"),
        ("bcd32", 20, 0, "int32"),
        ("bcd32", 0.1, 0, "float64"),
        ("uint64", 2, 0, "float64"),
    ],
)
def test_the_type_of_a_scaled_value(kind: str, scale: float, offset: int, type_: str) -> None:
    assert tag(kind, scale=scale, offset=offset).value_type == type_


def test_a_whole_scale_and_offset_keep_an_integer() -> None:
    for kind in KINDS:
        scaled = tag(kind, scale=2.0, offset=-3.0)
        assert orjson.dumps(scaled.decode(units_of(kind, 5))) == b"7"


def test_a_double_word_with_many_decimals_is_exact() -> None:
    flow = tag("uint32", Unit.DWORD, scale=1.234567, offset=0.0)
    assert flow.decode([4294967293]) == float(Decimal(4294967293) * Decimal("1.234567"))


def test_a_value_beyond_64_bits_is_the_next_float() -> None:
    wide = tag("uint64", scale=10)
    assert orjson.loads(orjson.dumps(wide.decode([0xFFFF] * 4))) == 1.8446744073709552e20
    assert type(tag("uint64", offset=1).decode([0xFFFF] * 4)) is float


@pytest.mark.parametrize("value", [float("nan"), 10**300, -1.0e300])
def test_a_value_out_of_range_is_refused(value: float) -> None:
    with pytest.raises(BadValue):
        tag("int64", scale=0.1).encode(value)


def test_a_tag_of_floats_has_no_such_limit() -> None:
    floats: Tag = tag("float64", scale=0.1)
    assert floats.exact_below is None


def _as_float(written: object) -> float:
    assert isinstance(written, int)
    return float(written)


def test_a_whole_number_of_the_file_keeps_its_digits() -> None:
    assert every_digit(2**53 + 1, _as_float) == 2**53 + 1
    assert type(every_digit(5, _as_float)) is float
    with pytest.raises(ConfigError, match="has more digits than the gateway keeps"):
        every_digit(2**64 + 1, _as_float)
