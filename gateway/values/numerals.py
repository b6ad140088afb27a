"""Numbers as people write them: shortest digits, whole numbers, decimals of JSON, distances."""

import math
import re
import struct
from collections.abc import Sequence
from decimal import Context, Decimal

from gateway.errors import BadValue

Scalar = bool | int | float | str
_SINGLE = struct.Struct(">f")
_TOO_LARGE_SINGLE = 2.0**128 - 2.0**103  # from here on a float of 32 bits is infinite
# In nanoseconds, from the longest on; `m` and `u` as Zenoh writes them.
TIMES = {"w": 604_800 * 10**9, "d": 86_400 * 10**9, "h": 3_600 * 10**9, "min": 60 * 10**9}
TIMES |= {"m": TIMES["min"], "s": 10**9, "ms": 10**6, "us": 10**3, "u": 10**3}
_TIME = re.compile(r"([0-9]{0,18})(?:\.([0-9]{0,18}))? ?([a-z]+) ?")
_NORMAL_SINGLE = 2.0**-126  # floats of 32 bits below have fewer than six digits
_WHOLE_FLOATS = 2.0**53  # from here on floats skip whole numbers
_WHOLE_SINGLES = 2.0**24  # the same for floats of 32 bits
_DECIMALS = Context(prec=60)  # more digits than two floats of one plant have together
_FLOAT_ERROR = 2.0**-50  # of a difference of two floats, as a part of them; eight times the most


def shortest(value: float) -> float | None:
    """Returns the shortest decimal of a 32-bit float: 0.1, not 0.10000000149011612."""
    if not math.isfinite(value):
        return None
    if value.is_integer() and abs(value) <= _WHOLE_SINGLES:
        return value
    packed = _SINGLE.pack(value)
    for digits in (6, 7, 8) if abs(value) >= _NORMAL_SINGLE else range(1, 9):
        short = float(f"{value:.{digits}g}")
        if abs(short) < _TOO_LARGE_SINGLE and _SINGLE.pack(short) == packed:
            return short
    return float(f"{value:.9g}")


def whole(value: Scalar) -> int:
    """Returns the value as an integer. Raises `BadValue` for other values."""
    if isinstance(value, (bool, str)):
        raise BadValue(f"{value!r} is not a number")
    if isinstance(value, float) and not value.is_integer():
        raise BadValue(f"{value} is not a whole number")
    return int(value)


def parse_decimal(text: str) -> int | float:
    """Returns the number of a JSON text with a point or an exponent, infinite if too large.

    It is an integer where a float would change a whole number of 64 bits: 9007199254740993.0.
    """
    number = float(text)
    if not _WHOLE_FLOATS <= abs(number) < 2.0**64:
        return number
    exact = Decimal(text)
    return int(exact) if exact == exact.to_integral_value() else number


def real(value: Scalar) -> float:
    """Returns the value as a finite float. Raises `BadValue` for other values."""
    if isinstance(value, (bool, str)):
        raise BadValue(f"{value!r} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise BadValue(f"{value} is not a finite number")
    return number


_TELEPHONE = re.compile(r"[0-9A-DF]{0,24}\Z")
_PLACES, _END = 24, "E"  # of the registers of a PLC, and the code behind the last digit


def telephone_number(words: Sequence[int]) -> str:
    """Returns a number as people write it, `2620-4976`. The lowest digit of a word is the first."""
    digits = "".join(f"{word:04X}"[::-1] for word in words).partition(_END)[0]
    return "-".join(digits[at : at + 4] for at in range(0, len(digits), 4))


def telephone_words(value: Scalar) -> list[int]:
    """Returns the inverse of `telephone_number`. Hyphens and spaces count nothing.

    The letters are other codes of the PLC, such as its pause. Raises `BadValue`.
    """
    digits = re.sub("[- ]", "", str(value)).upper()
    if isinstance(value, (bool, float)) or not _TELEPHONE.match(digits):
        raise BadValue(f"{value!r} is no telephone number: up to 24 digits, such as 2620-4976")
    digits = (digits + _END).ljust(_PLACES, "0")
    return [int(digits[at : at + 4][::-1], 16) for at in range(0, _PLACES, 4)]


def as_decimal(value: Scalar) -> Decimal:
    """Returns the number as people write it. Bits count 0 and 1."""
    return Decimal(repr(value)) if isinstance(value, float) else Decimal(int(value))


def are_apart(one: float, other: float, least: float, *, percent: bool = False) -> bool:
    """Returns True if two numbers differ by `least` or more, as people write all three.

    0.3 and 0.2 differ by 0.1: their floats differ by less. `percent`: of `one`.
    """
    band = abs(one) * least / 100 if percent else least
    difference = abs(other - one)
    if abs(difference - band) > (abs(one) + abs(other)) * _FLOAT_ERROR:
        return difference > band  # far from `least`: no digit behind decides
    first, exact = as_decimal(one), as_decimal(least)
    if percent:
        exact = _DECIMALS.multiply(first.copy_abs(), _DECIMALS.divide(exact, Decimal(100)))
    return _DECIMALS.subtract(as_decimal(other), first).copy_abs() >= exact


def nanoseconds(text: str) -> int | None:
    """Returns `500ms`, `1.5 h`, `1h30m`, `1h 30min`; None for a text that is no duration."""
    total, longest, at = 0, TIMES["w"] + 1, 0
    while at < len(text) or not text:
        match = _TIME.match(text, at)
        if match is None or not (match[1] or match[2]):
            return None
        unit, fraction = TIMES.get(match[3], longest), match[2] or ""
        if unit >= longest:  # unknown, or not shorter than the one before
            return None
        total += int(match[1] or 0) * unit + int(fraction or 0) * unit // 10 ** len(fraction)
        longest, at = unit, match.end()
    return total
