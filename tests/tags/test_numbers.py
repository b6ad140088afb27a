"""Numbers that are unpacked together are those that each tag decodes alone."""

from array import array
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gateway.protocols.driver import Span
from gateway.tags import Tag
from gateway.tags.numbers import numbers
from gateway.tags.scan import Decoder
from gateway.tags.shaping import PLAIN, Shaping
from gateway.values import STRUCT, Byte, Layout, Order, parse_type
from tests.sim.plant import make_tag

ORDERS = st.sampled_from(Order)
KINDS = st.sampled_from(sorted(STRUCT))
FORMS: list[Callable[[list[int]], Sequence[int]]] = [
    tuple,
    partial(array, "H"),
    partial(array, "I"),
]
SHAPES = st.sampled_from([Shaping(), Shaping(scale=0.1, offset=-3.0), Shaping(decimals=1)])


def number(name: str, layout: Layout, start: int, shaping: Shaping = PLAIN) -> Tag:
    span = Span("D", start, layout.type.words)
    return replace(make_tag("D0", name=name), layout=layout, span=span, shaping=shaping)


@st.composite
def rows(draw: st.DrawFn) -> tuple[list[Tag], list[int]]:
    """Tags with gaps between them, often of one order, and the words of a read."""
    words, octets = draw(ORDERS), draw(ORDERS)
    mixed, tags, at = draw(st.booleans()), list[Tag](), draw(st.integers(0, 3))
    for place in range(draw(st.integers(1, 8))):
        order = (draw(ORDERS), draw(ORDERS)) if mixed else (words, octets)
        layout = Layout(parse_type(draw(KINDS)), *order)
        tags.append(number(f"t{place}", layout, at, draw(SHAPES)))
        at += layout.type.words + draw(st.integers(0, 2))
    word = st.sampled_from([0, 1, 0x7FFF, 0x8000, 0x7F80, 0x7FC0, 0xFFFF]) | st.integers(0, 0xFFFF)
    return tags, draw(st.lists(word, min_size=at, max_size=at))


@given(rows(), st.data())
def test_a_row_of_numbers_has_the_values_of_its_tags(
    made: tuple[list[Tag], list[int]], data: st.DataObject
) -> None:
    tags, units = made
    form = data.draw(st.sampled_from(FORMS))  # of the units, as drivers read them
    begins = [tag.span.start for tag in tags]
    decoder = Decoder(tags, begins)

    def alone(units: list[int]) -> list[Any]:
        return [
            tag.decode(units[at : at + tag.span.size]) for tag, at in zip(tags, begins, strict=True)
        ]

    scan = decoder.first(form(units), 1)
    assert [sample.value for sample in scan] == alone(units)
    place = data.draw(st.integers(0, len(units) - 1))
    later = [*units]
    later[place] ^= data.draw(st.integers(1, 0xFFFF))
    after = decoder.after(scan, form(later), 2)
    assert [sample.value for sample in after] == alone(later)


def test_numbers_of_one_order_are_unpacked_together_others_are_not() -> None:
    high, low = Order.HIGH_FIRST, Order.LOW_FIRST
    one = number("a", Layout(parse_type("uint16")), 0)
    two = number("b", Layout(parse_type("int32"), high), 2)
    three = number("c", Layout(parse_type("float32"), low), 4)
    assert numbers([one, two], [0, 2]) is not None
    assert numbers([one, three], [0, 4]) is not None
    assert numbers([two, three], [2, 4]) is None
    assert numbers([two, one], [2, 0]) is None  # not in the order of their addresses
    byte = number("d", Layout(parse_type("int8"), byte=Byte.HIGH), 6)
    assert numbers([one, byte], [0, 6]) is None
