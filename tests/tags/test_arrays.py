"""Arrays: several values of one type in one tag, all from one read."""

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.errors import BadValue
from gateway.protocols.driver import Address, Span, Unit
from gateway.tags import Deadband, Reason, Sample, Tag, WriteRule, good
from gateway.tags.mirror import Mirror
from gateway.tags.scan import Decoder, Scan
from gateway.tags.shaping import Shaping
from gateway.values import NO_ELEMENTS, Kind, Layout, Order, Value, parse_type
from tests.tag_settings import grouped

MINUTE = 60 * 10**9


def array(kind: str, unit: Unit = Unit.WORD, order: Order = Order.LOW_FIRST, **more: Any) -> Tag:
    layout = Layout(parse_type(kind), order)
    return Tag(
        device="mixer",
        name="recipe",
        text="D100",
        address=Address("D", 100),
        span=Span("D", 100, layout.type.words // (2 if unit is Unit.DWORD else 1)),
        unit_kind=unit,
        layout=layout,
        **grouped(**more),
    )


@pytest.mark.parametrize(
    ("tag", "units", "value"),
    [
        (array("uint16[3]"), [1, 2, 0xFFFF], (1, 2, 65535)),
        (array("int16[2]"), [0xFFFF, 0x8000], (-1, -32768)),
        (array("uint16[1]"), [7], (7,)),
        (array("bcd16[2]"), [0x1234, 0x0009], (1234, 9)),
        (array("bool[3]", Unit.BIT), [1, 0, 1], (True, False, True)),
        (array("float32[2]"), [0, 0x4148, 0, 0xC148], (12.5, -12.5)),
        (array("int32[2]", order=Order.HIGH_FIRST), [0, 1, 0xFFFF, 0xFFFF], (1, -1)),
        (array("int32[2]", Unit.DWORD), [70000, 0xFFFFFFFF], (70000, -1)),
        (array("uint64[1]"), [0, 0, 0, 0x8000], (2**63,)),
        (array("int16[3]", scale=0.1), [1, 2, 3], (0.1, 0.2, 0.3)),
    ],
)
def test_an_array_has_the_values_of_its_elements_both_ways(
    tag: Tag, units: list[int], value: Value
) -> None:
    found = tag.decode(units)
    assert found == value
    assert isinstance(found, tuple)
    assert isinstance(value, tuple)
    assert list(map(type, found)) == list(map(type, value))
    assert tag.encode(value) == units
    assert tag.from_units(units) == value


kinds = st.sampled_from([kind for kind in Kind if kind not in (Kind.STRING, *NO_ELEMENTS)])


@given(st.data(), kinds, st.integers(1, 12), st.sampled_from(Order))
@settings(max_examples=40)
def test_what_an_array_shows_is_written_back_unchanged(
    data: st.DataObject, kind: Kind, count: int, order: Order
) -> None:
    tag = array(f"{kind}[{count}]", Unit.BIT if kind is Kind.BOOL else Unit.WORD, order)
    word = st.integers(0, 1 if kind is Kind.BOOL else 0xFFFF)
    size = tag.span.size
    units = data.draw(st.lists(word, min_size=size, max_size=size))
    value = tag.decode(units)
    if value is None:
        assert kind in (Kind.BCD16, Kind.BCD32, Kind.FLOAT32, Kind.FLOAT64)
        return
    assert isinstance(value, tuple)
    assert len(value) == count
    assert tag.decode(tag.encode(value)) == value


@pytest.mark.parametrize(
    ("tag", "units"),
    [
        (array("bcd16[3]"), [1, 0x00A0, 3]),
        (array("float32[2]"), [0, 0x4148, 0, 0x7FC0]),
        (array("float64[1]"), [0, 0, 0, 0x7FF0]),
    ],
)
def test_one_element_without_a_value_leaves_none(tag: Tag, units: list[int]) -> None:
    assert tag.decode(units) is None
    sample = Decoder([tag], [0]).first(units, MINUTE)[0]
    assert (sample.value, sample.reason) == (None, Reason.NOT_A_NUMBER)


@pytest.mark.parametrize(
    ("kind", "value", "why"),
    [
        ("uint16[3]", (1, 2, 70000), "element 2: 70000 does not fit uint16 (0 to 65535)"),
        ("uint16[3]", (1, "2", 3), "element 1: '2' is not a number"),
        ("uint16[3]", (1.5, 2, 3), "element 0: 1.5 is not a whole number"),
        ("uint16[3]", (True, 2, 3), "element 0: True is not a number"),
        ("float32[2]", (1.0, math.nan), "element 1: nan is not a finite number"),
        ("uint16[3]", (1, 2), "a list of 2 is written to uint16[3]: send 3"),
        ("uint16[3]", (1, 2, 3, 4), "a list of 4 is written to uint16[3]: send 3"),
        ("uint16[3]", (), "a list of 0 is written to uint16[3]: send 3"),
        ("uint16[1]", 7, "7 is no list: recipe is uint16[1]"),
        ("uint16", (7,), "recipe has one value: send no list"),
    ],
)
def test_a_write_of_another_shape_is_refused(kind: str, value: Value, why: str) -> None:
    with pytest.raises(BadValue) as refused:
        array(kind).encode(value)
    assert str(refused.value) == why


def test_the_limits_of_a_write_hold_for_each_element() -> None:
    tag = array("uint16[3]", write=WriteRule(min=10, max=20))
    assert tag.encode((10, 15, 20)) == [10, 15, 20]
    with pytest.raises(BadValue, match="element 1: 9 is below the least value 10"):
        tag.encode((10, 9, 20))


def test_shaping_is_that_of_each_element() -> None:
    tag = array("bool[3]", Unit.BIT, shaping=Shaping(invert=True))
    assert tag.decode([1, 0, 0]) == (False, True, True)
    assert tag.encode((False, True, True)) == [1, 0, 0]
    rounded = array("float32[2]", shaping=Shaping(decimals=1))
    assert rounded.decode([0xCCCD, 0x4148, 0, 0x4148]) == (12.6, 12.5)


def test_an_array_says_its_type_with_the_length() -> None:
    assert array("uint16[3]").value_type == "uint16[3]"
    assert array("bcd16[3]").value_type == "uint16[3]"
    assert array("float32[3]").value_type == "float32[3]"
    assert array("uint16[3]", scale=0.1).value_type == "float64[3]"


def scans(tag: Tag, *reads: list[int]) -> list[list[Value | None]]:
    """Returns the published values of each read of a block."""
    mirror, decoder, last = Mirror([tag], 0), Decoder([tag], [0]), None
    published = []
    for number, units in enumerate(reads, 1):
        scan: Scan = (
            decoder.first(units, number) if last is None else decoder.after(last, units, number)
        )
        published.append([sample.value for sample in mirror.update(scan)])
        last = scan
    return published


def test_an_array_is_published_when_one_element_changed() -> None:
    found = scans(array("uint16[3]"), [1, 2, 3], [1, 2, 3], [1, 5, 3])
    assert found == [[(1, 2, 3)], [], [(1, 5, 3)]]


def test_an_array_is_published_when_one_element_moved_by_the_deadband() -> None:
    tag = array("uint16[2]", deadband=Deadband(5))
    assert scans(tag, [10, 20], [14, 24], [15, 20], [19, 24]) == [[(10, 20)], [], [(15, 20)], []]


def test_a_deadband_in_percent_is_that_of_each_element() -> None:
    tag = array("uint16[2]", deadband=Deadband(10, percent=True))
    assert scans(tag, [10, 1000], [10, 1050], [11, 1050]) == [[(10, 1000)], [], [(11, 1050)]]


def test_an_element_of_zero_that_stays_is_no_move_in_percent() -> None:
    tag = array("uint16[2]", deadband=Deadband(10, percent=True))
    assert scans(tag, [0, 1000], [0, 1010], [1, 1010]) == [[(0, 1000)], [], [(1, 1010)]]


def test_a_copied_array_is_the_same_under_another_name() -> None:
    twin = array("uint16[3]", scale=0.1).copy("oven", "line")
    assert twin.key == "oven/line"
    assert twin.encode((0.1, 0.2, 0.3)) == [1, 2, 3]
    assert Sample(twin, twin.decode([1, 2, 3]), good(twin, 0, 0).quality, 0).value == (
        0.1,
        0.2,
        0.3,
    )
