"""Scale and offset of integers: exact in both directions, without binary fractions.

The settings count as the decimals that the file writes: 0.1 is one tenth. Prepared with the
configuration, so a read costs one multiplication, one addition and one division of integers.
"""

import math
from collections.abc import Callable
from fractions import Fraction

from gateway.errors import BadValue
from gateway.values import Kind, ValueType

_SMALLEST, _LARGEST = -(2**63), 2**64 - 1  # of a whole number in JSON
_SIGNED = (Kind.INT16, Kind.INT32, Kind.INT64)
_UNSIGNED = (Kind.UINT16, Kind.UINT32, Kind.UINT64)
_DIGITS = {Kind.BCD16: 4, Kind.BCD32: 8}


def scaled(scale: float, offset: float) -> Callable[[int], int | float | None]:
    """Returns the function from the integer of the device to the value of the tag.

    The value is an integer where scale and offset are whole. Otherwise it is the float next to the
    exact result. It is None beyond the range of floats.
    """
    factor, summand, divisor = _parts(scale, offset)
    if divisor != 1:
        return lambda raw: _quotient(raw * factor + summand, divisor)

    def whole(raw: int) -> int | float | None:
        number = raw * factor + summand
        return number if _SMALLEST <= number <= _LARGEST else _quotient(number, 1)

    return whole


def unscaled(value: float, scale: float, offset: float) -> int:
    """Returns the integer of the device next to `value`. Raises `BadValue`."""
    if not math.isfinite(value):
        raise BadValue(f"{value} is not a finite number")
    return round((_decimal(value) - _decimal(offset)) / _decimal(scale))


def exact_below(kind: ValueType, scale: float, offset: float) -> float | None:
    """Returns the amount below which a JSON number tells all values of the tag apart.

    None if it tells all apart: a written value is then the value that is read back.
    """
    factor, summand, divisor = _parts(scale, offset)
    ends = [raw * factor + summand for raw in _range(kind)]
    if divisor == 1 and all(_SMALLEST <= end <= _LARGEST for end in ends):
        return None
    greatest = _quotient(max(map(abs, ends)), divisor)
    step = abs(float(scale))
    if greatest is None or 2 * math.ulp(greatest) < step:
        return None
    if divisor == 1:
        return float(-_SMALLEST if min(ends) < _SMALLEST else _LARGEST)
    mantissa, exponent = math.frexp(step)
    # The distance of two floats is less than half a step below this.
    return math.ldexp(1.0, exponent + (51 if mantissa > 0.5 else 50))


def _parts(scale: float, offset: float) -> tuple[int, int, int]:
    """Returns factor, summand and divisor: value = (raw x factor + summand) / divisor."""
    by, plus = _decimal(scale), _decimal(offset)
    divisor = math.lcm(by.denominator, plus.denominator)
    return int(by * divisor), int(plus * divisor), divisor


def _decimal(number: float) -> Fraction:
    """Returns the number as people write it: one tenth for 0.1."""
    return Fraction(number) if isinstance(number, int) else Fraction(repr(number))


def _quotient(number: int, divisor: int) -> float | None:
    try:
        return number / divisor
    except OverflowError:
        return None


def _range(kind: ValueType) -> tuple[int, int]:
    bits = 16 * kind.words
    if kind.kind in _SIGNED:
        return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    if kind.kind in _UNSIGNED:
        return 0, 2**bits - 1
    return 0, 10 ** _DIGITS[kind.kind] - 1
