"""The type of a tag, and the order of its words and bytes."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, Any

from gateway.config.settings import parsers
from gateway.config.settings.setting_types import TYPE_SCHEMA, OrderName, Parsed, member
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings
from gateway.protocols.driver import Address, Addressing, Area, Unit
from gateway.values import BYTES, Byte, Kind, Layout, Order, ValueType

_WIDE = (Kind.INT32, Kind.UINT32, Kind.FLOAT32, Kind.BCD32)
_OF_WORDS = ("type", "word_order", "byte_order", "byte")


class LayoutSettings(Settings):
    type: Annotated[ValueType | None, Parsed(parsers.value_type, TYPE_SCHEMA)] = None
    """The type of the value, or of the elements of an array such as uint16[50]; left out: bool for
    a bit, a whole number otherwise."""
    word_order: OrderName = Order.LOW_FIRST
    """The word of a 32- or 64-bit value at the lower address."""
    byte_order: OrderName | None = None
    """The byte of each word that comes first."""


class ByteSettings(Settings):
    byte: Annotated[Byte | None, member(Byte, "is no byte of a word")] = None
    """The byte of the word that a uint8 or int8 has; left out: the low one."""


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    kind, given = facts.kind, own.model_fields_set
    if facts.field is not None:
        for setting in filter(given.__contains__, _OF_WORDS):
            yield setting, f"the field {facts.name} has its own type: remove {setting} here"
        return
    if facts.area is not None and facts.area.unit is Unit.DWORD:
        for setting in filter(given.__contains__, ("word_order", "byte_order")):
            yield setting, f"{facts.name} has 32 bits by nature: it needs no {setting}"
    elif "word_order" in given and not (kind.is_number and kind.element.words > 1):
        yield (
            "word_order",
            f"{facts.text} is {kind}: only numbers of 32 or 64 bits have a word_order",
        )
    if kind.kind in BYTES and "byte_order" in given:
        yield "byte_order", f"{facts.text} is one byte: write byte: low or byte: high"
    elif kind.kind in (Kind.BOOL, Kind.TELEPHONE) and "byte_order" in given:
        yield "byte_order", f"{facts.text} is {kind}: only words have a byte_order"
    if own.byte is not None and kind.kind not in BYTES:
        yield "byte", f"a {kind} has whole words: byte needs type: uint8 or int8"


FEATURE = Feature(defaults=LayoutSettings, own=ByteSettings, check=_check)


def default_type(driver: Addressing, unit: Unit) -> ValueType:
    match unit:
        case Unit.BIT:
            return ValueType(Kind.BOOL)
        case Unit.WORD:
            return ValueType(driver.traits.word_type)
        case Unit.DWORD:
            return ValueType(Kind.INT32)


_layout = lru_cache(maxsize=1024)(Layout)  # tags that are alike have one object


def layout_of(own: Any, settings: Any, driver: Addressing, area: Area, kind: ValueType) -> Layout:
    """Returns the layout of a checked tag."""
    if area.unit is Unit.DWORD:  # the driver puts it together, whatever its order on the wire
        return _layout(kind)
    if kind.kind in BYTES:
        return _layout(kind, byte=own.byte or Byte.LOW)
    usual = driver.traits.string_order if kind.kind is Kind.STRING else Order.HIGH_FIRST
    return _layout(kind, settings.word_order, settings.byte_order or usual)


def type_misfit(kind: ValueType, area: Area, address: Address, driver: Addressing) -> str | None:
    """Returns what is wrong with the type of a tag at an address."""
    spelt = driver.spell(address)
    if area.unit is Unit.BIT or address.bit is not None:
        what = "is a bit" if address.bit is None else "is one bit of a word"
        fits = kind.kind is Kind.BOOL and not (kind.count and address.bit is not None)
        return None if fits else f"{spelt} {what}: it can only be bool"
    if area.unit is Unit.DWORD:
        wide = ", ".join(_WIDE)
        return None if kind.kind in _WIDE else f"{spelt} has 32 bits, no {kind}: use one of {wide}"
    if kind.kind is Kind.BOOL and kind.count:
        return f"{spelt} is a word: a {kind} is an array of bits; for words write uint16[n]"
    if kind.kind is Kind.BOOL:
        bit = driver.spell(address._replace(bit=0))
        return f"{spelt} is a word: for one of its bits write {bit}, or name a type for the word"
    return None
