"""The functions from the units of a tag to its value, made with the configuration.

A tag without scale and shaping gets the plain function of its type: no setting costs it anything.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from gateway.errors import Garbled
from gateway.protocols.driver import Unit
from gateway.tags.scaling import Linear, scaled, scaled_float
from gateway.tags.shaping import Shaping, shaped
from gateway.values import BYTES, Byte, Layout, Value, from_number, from_word, from_words
from gateway.values.numerals import Scalar

Decode = Callable[[Any], Value | None]
DecodeOne = Callable[[Any], Scalar | None]  # of a value that is no array


class WordPart(NamedTuple):
    """The bits of a word that a tag has: one bit, or a byte. A write changes these alone."""

    shift: int
    mask: int

    @property
    def bits(self) -> int:
        """The bits of the word, each as 1."""
        return self.mask << self.shift

    def of(self, word: int) -> int:
        return word >> self.shift & self.mask

    def into(self, word: int, part: int) -> int:
        """Returns the word with another part."""
        return word & ~self.bits | part << self.shift


def part_of(layout: Layout, bit: int | None) -> WordPart | None:
    """Returns the part of the word that a tag has; None: it has whole words."""
    if bit is not None:
        return WordPart(bit, 1)
    if layout.type.kind in BYTES:
        return WordPart(8 if layout.byte is Byte.HIGH else 0, 0xFF)
    return None


@lru_cache(maxsize=4096)
def decoder(
    layout: Layout,
    unit: Unit,
    single: bool,
    bit: int | None,
    line: Linear | None,
    shaping: Shaping,
) -> DecodeOne:
    """Returns the function from units to value, shared by all tags of the same kind.

    `single`: it takes one unit, otherwise a sequence.
    """
    return with_shaping(_scaled(_plain(layout, unit, single, bit), layout, line), shaping)


def _plain(layout: Layout, unit: Unit, single: bool, bit: int | None) -> DecodeOne:
    if bit is not None:
        if single:
            return lambda unit: bool(unit >> bit & 1)
        return lambda units: bool(units[0] >> bit & 1)
    if unit is Unit.DWORD:
        narrow = from_words(layout)

        def words(units: Any) -> Scalar | None:
            dwords = (units,) if single else units
            return narrow([half for word in dwords for half in (word & 0xFFFF, word >> 16)])

        return words
    return from_word(layout) if single else from_words(layout)


def _scaled(plain: DecodeOne, layout: Layout, line: Linear | None) -> DecodeOne:
    if line is None or not layout.type.is_number:
        return plain
    if layout.type.is_float:
        float_of = scaled_float(line)

        def number(units: Any) -> Scalar | None:
            raw = plain(units)
            return raw if raw is None or isinstance(raw, str) else float_of(raw)

        return number
    value_of = scaled(line)

    def integer(units: Any) -> Scalar | None:
        raw = plain(units)
        return value_of(raw) if isinstance(raw, int) else None

    return integer


def with_shaping(decode: DecodeOne, shaping: Shaping) -> DecodeOne:
    """Returns the function with the shaping behind it, if there is one."""
    shape = shaped(shaping)
    if shape is None:
        return decode

    def value(units: Any) -> Scalar | None:
        found = decode(units)
        return None if found is None else shape(found)

    return value


def array_decoder(element: Decode, size: int) -> Decode:
    """Returns the function from the units of an array to its values.

    `size`: the units of an element. One element without a value leaves none: the list would have
    a gap where its reader expects a number.
    """

    def values(units: Sequence[Any]) -> Value | None:
        parts = units if size == 1 else (units[i : i + size] for i in range(0, len(units), size))
        found: tuple[Any, ...] = tuple(map(element, parts))
        return None if None in found else found

    return values


@lru_cache(maxsize=4096)
def number_decoder(layout: Layout, line: Linear | None, shaping: Shaping) -> DecodeOne:
    """Returns the function from a number, as the device holds it, to the value. `index` if they
    are the same."""
    return with_shaping(_scaled(from_number(layout.type.kind), layout, line), shaping)


@lru_cache(maxsize=4096)
def field_decoder(layout: Layout, line: Linear | None, shaping: Shaping) -> DecodeOne:
    """Returns the decoder for a field of a frame: its value or a `Garbled`."""

    def plain(raw: Scalar | Garbled) -> Scalar | None:
        return None if isinstance(raw, Garbled) else raw

    return with_shaping(_scaled(plain, layout, line), shaping)
