"""Bit errors on a wire: what a receiver makes of flipped bits."""

import math
import random
from collections.abc import Iterable
from dataclasses import dataclass


@dataclass
class Noise:
    """Bit errors. `before`: before the receiver checks the parity; `after`: after it."""

    before: float = 0.0
    after: float = 0.0


@dataclass
class Format:
    """A character format such as `7E1`, and the receiver's reaction to a broken character."""

    data_bits: int = 8
    parity: bool = False
    stop_bits: int = 1
    broken_as_zero: bool = False  # otherwise it is dropped

    @property
    def bits(self) -> int:
        return 1 + self.data_bits + self.parity + self.stop_bits


def spoil(data: bytes, noise: Noise, shape: Format, chance: random.Random) -> bytes:
    """Adds bit errors of both kinds, also in start, parity and stop bits."""
    if noise.before:
        data = strike(data, flips(len(data) * shape.bits, noise.before, chance), shape)
    out: list[int] = list(data)
    if noise.after:
        for bit in flips(len(out) * shape.data_bits, noise.after, chance):
            out[bit // shape.data_bits] ^= 1 << bit % shape.data_bits
    return bytes(out)


def strike(data: bytes, bits: Iterable[int], shape: Format) -> bytes:
    """Returns the bytes received when these bits flip, counted from the first start bit."""
    masks: dict[int, int] = {}
    for bit in bits:
        masks[bit // shape.bits] = masks.get(bit // shape.bits, 0) | 1 << bit % shape.bits
    out: list[int] = list(data)
    for place, mask in sorted(masks.items(), reverse=True):
        _break(out, place, mask, shape)
    return bytes(out)


def _break(out: list[int], place: int, mask: int, shape: Format) -> None:
    """Returns one character with flipped bits: bit 0 is the start bit, then data, parity, stop."""
    framed = mask & 1 or mask >> (1 + shape.data_bits + shape.parity)
    data = mask >> 1 & ((1 << shape.data_bits) - 1)
    parity = mask >> (1 + shape.data_bits) & 1 if shape.parity else 0
    odd = shape.parity and (data.bit_count() + parity) % 2
    if not framed and not odd:
        out[place] ^= data
    elif shape.broken_as_zero:
        out[place] = 0
    else:
        del out[place]


def flips(bits: int, rate: float, chance: random.Random) -> list[int]:
    """Returns the numbers of the bits that flip."""
    found = []
    scale = math.log1p(-rate)
    place = int(math.log(1.0 - chance.random()) / scale)
    while place < bits:
        found.append(place)
        place += 1 + int(math.log(1.0 - chance.random()) / scale)
    return found
