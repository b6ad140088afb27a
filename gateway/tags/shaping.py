"""Shaping of a value besides scale and offset, in both directions, and names of numbers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

from gateway.errors import BadValue
from gateway.tags.scaling import Ends, Linear, linear
from gateway.values import Value
from gateway.values.numerals import Scalar

Limited = Literal["low", "high"]


class Bounds(NamedTuple):
    """The least and the greatest value; None: there is none."""

    low: float | None = None
    high: float | None = None

    def exclude(self, value: Value | None) -> bool:
        """Returns True if the number, or an element of the array, is outside."""
        match value:
            case None | str() | bool():
                return False
            case tuple():
                return any(map(self.exclude, value))
        low, high = self
        return (low is not None and value < low) or (high is not None and value > high)


@dataclass(frozen=True, slots=True)
class Names:
    """The names of the values of a tag: `enum` in the file. A read gives the number."""

    by_number: Mapping[int, str] = field(hash=False)

    def number(self, value: Scalar) -> Scalar:
        """Returns the number of a value to write, or of its name. Raises `BadValue`."""
        if isinstance(value, str):
            for number, name in self.by_number.items():
                if name == value:
                    return number
            raise BadValue(f"{value!r} is no name of a value: use {self}")
        if value not in self.by_number:
            raise BadValue(f"{value} has no name: use {self}")
        return value

    def text(self, value: object) -> str | None:
        """Returns the name of a value that was read; None: it has no name."""
        return self.by_number.get(value) if isinstance(value, int) else None

    def __str__(self) -> str:
        return ", ".join(f"{number} ({name})" for number, name in self.by_number.items())


@dataclass(frozen=True, slots=True, kw_only=True)
class Shaping:
    """The way from the number of the device to the value: it is scaled, rounded, then clamped."""

    scale: float = 1.0
    offset: float = 0.0
    ends: Ends | None = None  # instead of scale and offset
    decimals: int | None = None
    clamp: Bounds | None = None
    range: Bounds | None = None  # of the sensor: a value outside is uncertain
    invert: bool = False  # of a bit
    names: Names | None = None

    @property
    def line(self) -> Linear | None:
        """The scaling; None: it changes nothing."""
        return linear(self.scale, self.offset, self.ends)

    @property
    def exact(self) -> "Shaping":
        """The same without rounding and limits: the value that the device really holds."""
        if self.decimals is None and self.clamp is None:
            return self
        return replace(self, decimals=None, clamp=None)

    def limited(self, value: Value | None) -> "Limited | None":
        """Returns the end of the clamp that the value, or an element, is at; None: at no end."""
        if self.clamp is None or isinstance(value, (str, bool)) or value is None:
            return None
        if isinstance(value, tuple):
            return next(filter(None, map(self.limited, value)), None)
        low, high = self.clamp
        if low is not None and value <= low:
            return "low"
        return "high" if high is not None and value >= high else None

    def rounded(self, value: Scalar) -> Scalar:
        """Returns a value to write with as many decimals as a read shows."""
        if self.decimals is None or not isinstance(value, float):
            return value
        return round(value, self.decimals)

    def check(self, value: Scalar) -> None:
        """Raises `BadValue` for a value that no read would show, because of the clamp."""
        if self.clamp is not None and self.clamp.exclude(value):
            low, high = self.clamp
            raise BadValue(f"{value} is outside the clamp: {low} to {high}")


PLAIN = Shaping()
Convert = Callable[[Scalar], Scalar | None]


def shaped(shaping: Shaping) -> Convert | None:
    """Returns the function from the scaled to the shaped value; None: they are equal."""
    if shaping.invert:
        return lambda value: not value
    decimals, clamp = shaping.decimals, shaping.clamp
    if clamp is None:
        return None if decimals is None else lambda value: _rounded(value, decimals)
    low = -float("inf") if clamp.low is None else clamp.low
    high = float("inf") if clamp.high is None else clamp.high

    def limited(value: Scalar) -> Scalar:
        if decimals is not None:
            value = _rounded(value, decimals)
        if isinstance(value, str):
            return value
        if low <= value <= high:
            return value
        limit = low if value < low else high
        return float(limit) if isinstance(value, float) else int(limit)

    return limited


def _rounded(value: Scalar, decimals: int) -> Scalar:
    # `+ 0.0`: -0.04 is shown as 0.0, not as -0.0.
    return round(value, decimals) + 0.0 if isinstance(value, float) else value
