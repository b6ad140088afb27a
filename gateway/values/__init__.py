"""Conversion between words and values: types, word and byte order, BCD, strings, arrays.

Words are unsigned 16-bit integers in the order of their addresses. Each conversion is built
once, with the configuration, as a plain function.
"""

import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from operator import index
from typing import Any

from gateway.errors import BadValue, ConfigError
from gateway.values.numerals import (
    Scalar,
    real,
    shortest,
    telephone_number,
    telephone_words,
    whole,
)

Value = Scalar | tuple[Scalar, ...]  # several: of an array
Words = Sequence[int]
FromWords = Callable[[Words], Scalar | None]
FromWord = Callable[[int], Scalar | None]
ToWords = Callable[[Scalar], list[int]]


class Kind(StrEnum):
    BOOL = "bool"
    INT8 = "int8"
    UINT8 = "uint8"
    INT16 = "int16"
    UINT16 = "uint16"
    INT32 = "int32"
    UINT32 = "uint32"
    INT64 = "int64"
    UINT64 = "uint64"
    FLOAT32 = "float32"
    FLOAT64 = "float64"
    BCD16 = "bcd16"
    BCD32 = "bcd32"
    STRING = "string"
    TELEPHONE = "telephone"  # the registers of a Vigor PLC with a modem


class Order(StrEnum):
    """The order of the words of a number, or of the bytes of a word."""

    LOW_FIRST = "low_first"
    HIGH_FIRST = "high_first"


class Byte(StrEnum):
    """The byte of a word that holds a value of 8 bits."""

    LOW = "low"
    HIGH = "high"


STRUCT: dict[str, str] = {  # by kind
    Kind.INT8: ">b",
    Kind.UINT8: ">B",
    Kind.INT16: ">h",
    Kind.UINT16: ">H",
    Kind.INT32: ">i",
    Kind.UINT32: ">I",
    Kind.INT64: ">q",
    Kind.UINT64: ">Q",
    Kind.FLOAT32: ">f",
    Kind.FLOAT64: ">d",
}
_WORDS: dict[str, int] = {Kind.BOOL: 1, Kind.BCD16: 1, Kind.BCD32: 2, Kind.TELEPHONE: 6} | {
    kind: (struct.calcsize(form) + 1) // 2 for kind, form in STRUCT.items()
}
_FLOATS = (Kind.FLOAT32, Kind.FLOAT64)
_BCD = (Kind.BCD16, Kind.BCD32)
BYTES = (Kind.INT8, Kind.UINT8)
NO_ELEMENTS = (*BYTES, Kind.TELEPHONE)  # of an array
LONGEST_STRING = 250
LONGEST_ARRAY = 2000  # elements: as many bits as one request of Modbus reads


@dataclass(frozen=True, slots=True)
class ValueType:
    """A tag's type as the file writes it.

    `length` counts the characters of a string, `count` the elements of an array; 0: no array.
    """

    kind: Kind
    length: int = 0
    count: int = 0

    @property
    def words(self) -> int:
        """The number of 16-bit words of a value, of all elements of an array."""
        if self.kind is Kind.STRING:
            return (self.length + 1) // 2
        return _WORDS[self.kind] * (self.count or 1)

    @property
    def bits(self) -> int:
        """The number of bits of a number."""
        return 8 if self.kind in BYTES else 16 * _WORDS[self.kind]

    @property
    def element(self) -> "ValueType":
        """The type of one element of an array; the type itself if it is no array."""
        return replace(self, count=0) if self.count else self

    def holds(self, number: int) -> bool:
        """Returns True if a number of this type can be `number`."""
        try:
            to_words(Layout(self))(number)
        except BadValue:
            return False
        return True

    @property
    def is_number(self) -> bool:
        return not (self.is_text or self.kind is Kind.BOOL)

    @property
    def is_text(self) -> bool:
        return self.kind in (Kind.STRING, Kind.TELEPHONE)

    @property
    def is_float(self) -> bool:
        return self.kind in _FLOATS

    def __str__(self) -> str:
        size = self.length or self.count
        return f"{self.kind}[{size}]" if size else self.kind.value


_SIZED = re.compile(r"([a-z0-9]+)\[([0-9]{1,4})\]\Z")


def parse_type(text: str) -> ValueType:
    """Returns the type for `int16`, `uint16[50]`, `string[16]` ... Raises `ConfigError`."""
    match = _SIZED.match(text)
    name, size = (match[1], int(match[2])) if match else (text, 0)
    if match and name == Kind.STRING:
        if not 1 <= size <= LONGEST_STRING:
            raise ConfigError(f"{text}: a string has 1 to {LONGEST_STRING} characters")
        return ValueType(Kind.STRING, size)
    known = [kind.value for kind in Kind if kind is not Kind.STRING]
    if name not in known:
        raise ConfigError(
            f"{text!r} is not a type: use {', '.join(known)} or string[n], or an array such as "
            "uint16[50]"
        )
    kind = Kind(name)
    if match and kind in NO_ELEMENTS:
        raise ConfigError(f"{text}: an array has whole words or bits: use uint16[n] or int16[n]")
    if match and not 1 <= size <= LONGEST_ARRAY:
        raise ConfigError(f"{text}: an array has 1 to {LONGEST_ARRAY} elements")
    return ValueType(kind, count=size)


@dataclass(frozen=True, slots=True)
class Layout:
    """The position of a value's words and bytes.

    `byte_order` `low_first` swaps the two bytes of every word.
    """

    type: ValueType
    word_order: Order = Order.LOW_FIRST
    byte_order: Order = Order.HIGH_FIRST
    byte: Byte = Byte.LOW  # for 8 bits

    @property
    def element(self) -> "Layout":
        """The layout of one element of an array."""
        return replace(self, type=self.type.element)


def from_words(layout: Layout) -> FromWords:
    """Returns the function that turns the words of one value into the value.

    That function returns None for words without a value: a float that is NaN or infinite, BCD
    with a digit above 9.
    """
    kind = layout.type.kind
    if kind is Kind.STRING:
        length = layout.type.length
        return lambda words: _text(_octets(words, layout.byte_order)[:length])
    if kind is Kind.BOOL:
        return lambda words: bool(words[0])
    if kind in BYTES:
        shift, sign = (8 if layout.byte is Byte.HIGH else 0), 0x80 if kind is Kind.INT8 else 0
        return lambda words: ((words[0] >> shift & 0xFF) ^ sign) - sign
    if kind in _BCD:
        return lambda words: _from_bcd(_ordered(words, layout))
    if kind is Kind.TELEPHONE:
        return telephone_number
    unpack, number = struct.Struct(STRUCT[kind]).unpack, from_number(kind)
    return lambda words: number(unpack(_octets(_ordered(words, layout)))[0])


def from_number(kind: Kind) -> Callable[[Any], Scalar | None]:
    """Returns the function that turns a number, as `struct` unpacks it, into the value."""
    if kind is Kind.FLOAT32:
        return shortest
    return _finite if kind is Kind.FLOAT64 else index


def from_word(layout: Layout) -> FromWord:
    """Returns `from_words` for a value of one word, which the function takes without a sequence."""
    kind = layout.type.kind
    if kind is Kind.UINT16 and layout.byte_order is Order.HIGH_FIRST:
        return index  # the word itself
    if kind is Kind.INT16 and layout.byte_order is Order.HIGH_FIRST:
        return lambda word: word - 0x10000 if word & 0x8000 else word
    of_words = from_words(layout)
    return bool if kind is Kind.BOOL else lambda word: of_words((word,))


def to_words(layout: Layout) -> ToWords:
    """Returns the inverse of `from_words`. It raises `BadValue` for a value that does not fit.

    A value of 8 bits gives the byte alone.
    """
    kind = layout.type.kind
    if kind is Kind.STRING:
        return lambda value: _string_words(value, layout)
    if kind is Kind.BOOL:
        return lambda value: [int(_boolean(value))]
    if kind in BYTES:
        return lambda value: [_byte(whole(value), kind)]
    if kind in _BCD:
        digits = 4 * layout.type.words
        return lambda value: _ordered(_to_bcd(whole(value), digits), layout)
    if kind is Kind.TELEPHONE:
        return telephone_words
    pack = struct.Struct(STRUCT[kind]).pack
    convert: Callable[[Scalar], int | float] = real if kind in _FLOATS else whole

    def encode(value: Scalar) -> list[int]:
        number = convert(value)
        try:
            raw = pack(number)
        except (struct.error, OverflowError):
            raise BadValue(f"{value} does not fit {kind.value} ({_bounds(kind)})") from None
        return _ordered(struct.unpack(f">{len(raw) // 2}H", raw), layout)

    return encode


def _byte(value: int, kind: Kind) -> int:
    try:
        (byte,) = struct.pack(STRUCT[kind], value)
    except struct.error:
        raise BadValue(f"{value} does not fit {kind.value} ({_bounds(kind)})") from None
    return int(byte)


def _ordered(words: Words, layout: Layout) -> list[int]:
    """Turns words by address into words with the most significant first, and back."""
    row = [swapped(word) for word in words] if layout.byte_order is Order.LOW_FIRST else list(words)
    return row[::-1] if layout.word_order is Order.LOW_FIRST else row


def swapped(word: int) -> int:
    """Returns the word with its two bytes swapped."""
    return (word >> 8) | (word & 0xFF) << 8


def _octets(words: Words, order: Order = Order.HIGH_FIRST) -> bytes:
    return struct.pack(f"{'>' if order is Order.HIGH_FIRST else '<'}{len(words)}H", *words)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _text(octets: bytes) -> str:
    return octets.split(b"\0", 1)[0].decode("latin-1")


def _string_words(value: Scalar, layout: Layout) -> list[int]:
    if not isinstance(value, str):
        raise BadValue(f"{value!r} is not text")
    length = layout.type.length
    try:
        octets = value.encode("latin-1")
    except UnicodeEncodeError:
        raise BadValue(f"{value!r} has characters that are not in Latin-1") from None
    if len(octets) > length:
        raise BadValue(f"{value!r} is longer than {length} characters")
    if b"\0" in octets:
        raise BadValue("a text cannot contain the character NUL")
    octets = octets.ljust(2 * layout.type.words, b"\0")
    prefix = ">" if layout.byte_order is Order.HIGH_FIRST else "<"
    return list(struct.unpack(f"{prefix}{layout.type.words}H", octets))


def _boolean(value: Scalar) -> bool:
    if isinstance(value, str) or value not in (0, 1):
        raise BadValue(f"{value!r} is neither true nor false")
    return bool(value)


def _bounds(kind: Kind) -> str:
    if kind in _FLOATS:
        return "up to 3.4e38 either way" if kind is Kind.FLOAT32 else "up to 1.8e308 either way"
    bits = ValueType(kind).bits
    if kind.value.startswith("u"):
        return f"0 to {2**bits - 1}"
    return f"{-(2 ** (bits - 1))} to {2 ** (bits - 1) - 1}"


def _from_bcd(words: Words) -> int | None:
    digits = "".join(f"{word:04x}" for word in words)
    return int(digits) if digits.isdecimal() else None


def _to_bcd(value: int, digits: int) -> list[int]:
    if not 0 <= value < 10**digits:
        raise BadValue(f"{value} does not fit {digits} BCD digits (0 to {10**digits - 1})")
    text = f"{value:0{digits}}"
    return [int(text[i : i + 4], 16) for i in range(0, digits, 4)]
