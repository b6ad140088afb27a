"""Scale and offset: exact in both directions, without binary fractions.

The settings count as the decimals that the file writes: 0.1 is one tenth. Prepared with the
configuration, so the read of an integer costs one multiplication, one addition and one division.
"""

import math
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

from gateway.errors import BadValue
from gateway.values import Kind, ValueType

_SMALLEST, _LARGEST = -(2**63), 2**64 - 1  # of a whole number in JSON
_SIGNED = (Kind.INT8, Kind.INT16, Kind.INT32, Kind.INT64)
_WHOLE = (Kind.UINT16, Kind.INT32, Kind.UINT32, Kind.INT64, Kind.UINT64)
_DIGITS = {Kind.BCD16: 4, Kind.BCD32: 8}


class Ends(NamedTuple):
    """Two values of the device, and the values of the tag there: `from` and `to` in the file."""

    raw: tuple[float, float]
    value: tuple[float, float]


class Linear(NamedTuple):
    """value = raw x factor + summand"""

    factor: Fraction
    summand: Fraction

    @property
    def parts(self) -> tuple[int, int, int]:
        """Factor, summand and divisor: value = (raw x factor + summand) / divisor."""
        by, plus = self
        divisor = math.lcm(by.denominator, plus.denominator)
        return int(by * divisor), int(plus * divisor), divisor


@lru_cache(maxsize=4096)
def linear(scale: float, offset: float, ends: Ends | None = None) -> Linear | None:
    """Returns the line of a scale and an offset, or through two ends; None: it changes nothing."""
    by, plus = decimal(scale), decimal(offset)
    if ends is not None:
        (raw, last_raw), (value, last_value) = (map(decimal, pair) for pair in ends)
        by = (last_value - value) / (last_raw - raw)
        plus = value - raw * by
    return None if by == 1 and plus == 0 else Linear(by, plus)


def scaled(line: Linear) -> Callable[[int], int | float | None]:
    """Returns the function from the integer of the device to the value of the tag.

    The value is an integer where factor and summand are whole. Otherwise it is the float next to
    the exact result. It is None beyond the range of floats.
    """
    factor, summand, divisor = line.parts
    if divisor != 1:
        return lambda raw: _quotient(raw * factor + summand, divisor)

    def whole(raw: int) -> int | float | None:
        number = raw * factor + summand
        return number if _SMALLEST <= number <= _LARGEST else _quotient(number, 1)

    return whole


def scaled_float(line: Linear) -> Callable[[float], float | None]:
    """Returns the function from the float of the device to the value of the tag.

    It calculates with the decimals of the float: 2353.88 x 0.1 is 235.388, and nothing behind.
    """
    factor, summand, divisor = map(Decimal, line.parts)

    def value(raw: float) -> float | None:
        number = float((Decimal(repr(raw)) * factor + summand) / divisor)
        return number if math.isfinite(number) else None

    return value


def unscaled(value: float, line: Linear) -> int:
    """Returns the integer of the device next to `value`. Raises `BadValue`."""
    if not math.isfinite(value):
        raise BadValue(f"{value} is not a finite number")
    return round((decimal(value) - line.summand) / line.factor)


def unscaled_float(value: float, line: Linear) -> float:
    """Returns the float of the device for `value`; infinite where it is too large for one."""
    factor, summand, divisor = map(Decimal, line.parts)
    return float((Decimal(repr(value)) * divisor - summand) / factor)


def exact_below(kind: ValueType, line: Linear) -> float | None:
    """Returns the amount below which a JSON number tells all values of the tag apart.

    None if it tells all apart: a written value is then the value that is read back.
    """
    low, high, divisor = _reach(kind, line)
    if divisor == 1 and all(_SMALLEST <= end <= _LARGEST for end in (low, high)):
        return None
    greatest = _quotient(max(abs(low), abs(high)), divisor)
    step = abs(float(line.factor))
    if greatest is None or 2 * math.ulp(greatest) < step:
        return None
    if divisor == 1:
        return float(-_SMALLEST if low < _SMALLEST else _LARGEST)
    mantissa, exponent = math.frexp(step)
    # The distance of two floats is less than half a step below this.
    return math.ldexp(1.0, exponent + (51 if mantissa > 0.5 else 50))


def type_of(kind: ValueType, line: Linear | None) -> str:
    """Returns the type of the value: that of the device, or what digits or a scale make of it."""
    if not kind.is_number or (kind.is_float and line is None):
        return str(kind)
    if kind.is_float:
        return Kind.FLOAT64.value
    low, high, divisor = _reach(kind, line or Linear(Fraction(1), Fraction(0)))
    if divisor == 1:
        for wider in (kind.kind, *_WHOLE):
            if wider not in _DIGITS:
                least, most = _range(ValueType(wider))
                if least <= low and high <= most:
                    return wider.value
    return Kind.FLOAT64.value


def _reach(kind: ValueType, line: Linear) -> tuple[int, int, int]:
    """Returns the least and the greatest value of the tag, both times the divisor, and that."""
    factor, summand, divisor = line.parts
    low, high = sorted(raw * factor + summand for raw in _range(kind))
    return low, high, divisor


def decimal(number: float) -> Fraction:
    """Returns the number as people write it: one tenth for 0.1."""
    return Fraction(number) if isinstance(number, int) else Fraction(repr(number))


def _quotient(number: int, divisor: int) -> float | None:
    try:
        return number / divisor
    except OverflowError:
        return None


def _range(kind: ValueType) -> tuple[int, int]:
    if kind.kind in _DIGITS:
        return 0, 10 ** _DIGITS[kind.kind] - 1
    if kind.kind in _SIGNED:
        return -(2 ** (kind.bits - 1)), 2 ** (kind.bits - 1) - 1
    return 0, 2**kind.bits - 1
