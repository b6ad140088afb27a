"""Numbers as people write them: the shortest digits of a float, whole numbers, decimals of JSON."""

import math
import struct
from decimal import Decimal

from gateway.errors import BadValue

Scalar = bool | int | float | str
_SINGLE = struct.Struct(">f")
_TOO_LARGE_SINGLE = 2.0**128 - 2.0**103  # from here on a float of 32 bits is infinite
_NORMAL_SINGLE = 2.0**-126  # floats of 32 bits below have fewer than six digits
_WHOLE_FLOATS = 2.0**53  # from here on floats skip whole numbers
_WHOLE_SINGLES = 2.0**24  # the same for floats of 32 bits


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
