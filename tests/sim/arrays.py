"""Arrays: their place in a plant, the clocks of their elements, and what a PLC's units show.

All conversions are written a second time here: an oracle for those of the gateway.
"""

import random
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from gateway.protocols.driver import Unit
from gateway.tags import Tag
from gateway.values import Kind, Value
from tests.sim.more import LATER, rule

WORDS = (2, 7, 20, 33, 50)  # lengths in words; a Modbus device may take fewer in one request
BITS = (3, 8, 12, 30, 60)
BLINK = 4096  # ms between two changes of a moving bit
EXACT = 0x7F_FFFF  # numbers up to here are exact as float32


def add_arrays(lines: dict[str, Any], seed: int) -> None:
    """Adds arrays to most PLCs: two that move, two to write, single elements of both."""
    if seed < LATER:
        return
    chance = random.Random(f"arrays {seed}")
    for line in lines.values():
        for device in line["devices"].values():
            if "w1" in device["tags"] and chance.random() < 0.7:
                _add(device, chance)


def _add(device: dict[str, Any], chance: random.Random) -> None:
    tags, modbus = device["tags"], device["protocol"].startswith("modbus")
    written = tags["w0"]["address"]
    area, bits = ("holding:", "coil:") if modbus else ("D", "M")
    first = int(written.removeprefix(area)) + 30
    most = device.get("max_read_words", 125)
    if modbus and chance.random() < 0.5:
        device["max_write_words"] = chance.choice((2, 3, 10))  # a write takes several requests
    for number, at in ((0, first), (2, first + 60 * chance.choice((1, 1, 3)))):
        kind = chance.choice(("uint16", "uint16", "uint32", "float32"))
        words = min(most, chance.choice(WORDS))
        count = max(1, words // (1 if kind == "uint16" else 2))
        tags[f"a{number}"] = {"address": f"{area}{at}", "type": f"{kind}[{count}]"}
        if kind == "uint16" and chance.random() < 0.5:
            inside = f"{area}{at + chance.randrange(count)}"
            tags[f"e{number}"] = {"address": inside, "type": "uint16"}
    for number, at in ((1, 1000), (3, 1100)):
        address, count = at + chance.randrange(30), chance.choice(BITS)
        tags[f"a{number}"] = {"address": f"{bits}{address}", "type": f"bool[{count}]"}
    for name in ("a2", "a3"):
        tags[name]["write"] = rule(chance)
    if not modbus and chance.random() < 0.3:
        tags["a4"] = {"address": "C210", "type": f"uint32[{chance.choice((2, 9))}]"}
    if tags["a0"]["type"].startswith("uint16") and chance.random() < 0.3:
        tags["a0"]["scale"] = 0.1


def _hashed(step: int, own: int, coarse: int) -> int:
    """Returns the value of a clock at a step: the step, or any number where it is coarse."""
    return (step * 2_654_435_761 + own) % 2**32 if coarse else step


@dataclass(frozen=True)
class Clocks:
    """The clocks of the elements of an array. Times in milliseconds."""

    tag: Tag
    own: tuple[int, ...]  # the offset of each element
    coarse: int  # bits left out

    @property
    def kind(self) -> Kind:
        return self.tag.layout.type.kind

    def raw(self, element: int, ms: int) -> int:
        """Returns the number that an element has before it is scaled."""
        own = self.own[element]
        if self.kind is Kind.BOOL:
            return (ms + own) // BLINK & 1
        number = _hashed((ms + own) >> self.coarse, own, self.coarse)
        match self.kind:
            case Kind.UINT16:
                return number & 0xFFFF
            case Kind.FLOAT32:
                return number & EXACT
        return number & 0xFFFF_FFFF

    def unit(self, place: int) -> Callable[[float], int]:
        """Returns the motion of one unit of the array."""
        size = self.tag.span.size // len(self.own)
        element, part = divmod(place, size)
        if self.kind is Kind.FLOAT32:
            return lambda now: _words(float(self.raw(element, int(now * 1000))))[part]
        mask = 0xFFFF if self.tag.unit_kind is Unit.WORD else 0xFFFF_FFFF
        return lambda now: self.raw(element, int(now * 1000)) >> 16 * part & mask

    def had(self, value: Value, first: int, last: int) -> bool:
        """All elements had their values at one moment."""
        if not isinstance(value, tuple) or len(value) != len(self.own):
            return False
        tag = self.tag
        seen = [round((float(one) - tag.shaping.offset) / tag.shaping.scale) for one in value]
        return any(
            all(self.raw(element, ms) == one for element, one in enumerate(seen))
            for ms in self._moments(seen[0], first, last)
        )

    def _moments(self, seen: int, first: int, last: int) -> Iterator[int]:
        """Yields the moments at which the elements can have been, that of `seen` the first."""
        yield first
        if self.coarse or self.kind is Kind.BOOL:
            step = 1 << self.coarse if self.kind is not Kind.BOOL else BLINK
            for own in self.own:
                ms = first + (-first - own) % step
                while ms <= last:
                    yield ms
                    ms += step
            return
        top = {Kind.UINT16: 1 << 16, Kind.FLOAT32: EXACT + 1}.get(self.kind, 1 << 32)
        ms = first + (seen - self.own[0] - first) % top
        if ms <= last:
            yield ms


def _words(number: float) -> tuple[int, int]:
    """The two words of a float32, the low one first."""
    low, high = struct.unpack("<HH", struct.pack("<f", number))
    return low, high


def shown(tag: Tag, units: Sequence[int]) -> Value | None:
    """Returns the value that these units of the PLC show; that of an array without the gateway."""
    kind = tag.layout.type
    if not kind.count:
        return tag.decode(units)
    match kind.kind:
        case Kind.BOOL:
            return tuple(map(bool, units))
        case Kind.FLOAT32:
            pairs = zip(units[::2], units[1::2], strict=True)
            return tuple(struct.unpack("<f", struct.pack("<HH", *pair))[0] for pair in pairs)
        case Kind.UINT32 if tag.unit_kind is Unit.WORD:
            return tuple(
                low | high << 16 for low, high in zip(units[::2], units[1::2], strict=True)
            )
    return tuple(units)


def value_of(tag: Tag, number: int) -> Value:
    """Returns a value to write: the elements differ from each other, and from those before."""
    kind = tag.layout.type
    numbers = [(number + n) * 2_654_435_761 % 2**32 >> 4 for n in range(kind.count or 1)]
    match kind.kind:
        case Kind.BOOL:
            values: tuple[Any, ...] = tuple(bool(one >> 7 & 1) for one in numbers)
        case Kind.FLOAT32:
            values = tuple(float(one & EXACT) for one in numbers)
        case Kind.UINT16:
            values = tuple(one & 0xFFFF for one in numbers)
        case _:
            values = tuple(numbers)
    return values if kind.count else values[0]
