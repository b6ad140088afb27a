"""Numbers in a read of words: all of them are unpacked by one call in C.

A block qualifies if each of its tags is one number of its own words, and one order of bytes fits
all: words of a read become bytes, and the bytes numbers. Bits, texts, digits and arrays do not.
"""

import sys
from array import array
from collections.abc import Callable, Sequence
from functools import lru_cache
from operator import index
from struct import Struct
from typing import Any

from gateway.protocols.driver import Unit
from gateway.tags.decoding import DecodeOne, number_decoder
from gateway.tags.tag import Tag
from gateway.values import BYTES, STRUCT, Layout, Order

Unpack = Callable[[Sequence[int]], tuple[Any, ...]]
_BIG, _LITTLE = ">", "<"


def numbers(
    tags: Sequence[Tag], begins: Sequence[int]
) -> tuple[Unpack, Sequence[DecodeOne] | None] | None:
    """Returns the function from the units of a read to the numbers of the tags, and the functions
    from each number to its value; None: they are the values. None if the tags do not qualify."""
    form, end, orders = "", 0, {(_BIG, _BIG), (_BIG, _LITTLE), (_LITTLE, _BIG), (_LITTLE, _LITTLE)}
    known: dict[object, tuple[str, DecodeOne]] = {}  # tags of a block are alike as a rule
    converts: list[DecodeOne] = []
    for tag, begin in zip(tags, begins, strict=True):
        size = tag.span.size
        alike = id(tag.layout), id(tag.shaping), id(tag.origin), tag.address.bit, size
        if (found := known.get(alike)) is None:
            code = STRUCT.get(tag.layout.type.kind)
            if code is None or not _is_number(tag):
                return None
            convert = number_decoder(tag.layout, tag.line, tag.shaping)
            found = known[alike] = code[1:], convert
            orders &= _orders(tag.layout, size)
        if begin < end:
            return None
        form += f"{2 * (begin - end)}x{found[0]}"
        end = begin + size
        converts.append(found[1])
    if not orders:
        return None
    words, octets = min(orders)
    plain = all(convert is index for convert in converts)
    return _unpack(words, octets, end, form), None if plain else converts


def _is_number(tag: Tag) -> bool:
    origin, kind = tag.origin, tag.layout.type.kind
    others = (origin.shape, origin.formula, origin.kept, tag.element, tag.address.bit)
    return (
        tag.unit_kind is Unit.WORD and kind not in BYTES and all(other is None for other in others)
    )


def _orders(layout: Layout, words: int) -> set[tuple[str, str]]:
    """Returns the orders in which words become bytes, and bytes numbers."""
    if words == 1:
        same = layout.byte_order is Order.HIGH_FIRST
        return {(a, b) for a in (_BIG, _LITTLE) for b in (_BIG, _LITTLE) if (a == b) is same}
    number = _BIG if layout.word_order is Order.HIGH_FIRST else _LITTLE
    if layout.byte_order is Order.HIGH_FIRST:
        return {(number, number)}
    return {(_LITTLE if number == _BIG else _BIG, number)}


@lru_cache(maxsize=4096)  # blocks of equal devices share it
def _unpack(words: str, octets: str, count: int, form: str) -> Unpack:
    pack, unpack = Struct(f"{words}{count}H").pack, Struct(f"{octets}{form}").unpack
    swaps = (words == _LITTLE) is not (sys.byteorder == "little")

    def found(units: Sequence[int]) -> tuple[Any, ...]:
        if not (isinstance(units, array) and units.typecode == "H"):
            return unpack(pack(*units[:count]))
        some = units[:count]  # in the order of this machine: no word becomes an object
        if swaps:
            some.byteswap()
        return unpack(some)

    return found
