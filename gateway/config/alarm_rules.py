"""The rules of `alarm:` of a tag: which limits belong together, and which tag can have them."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, Protocol

from gateway.tags import AlarmRule, Level
from gateway.tags.scaling import decimal
from gateway.values import Kind, ValueType

_RISING = (Level.LOW_LOW, Level.LOW, Level.HIGH, Level.HIGH_HIGH)
_OF_BITS = {Level.ON: 1.0, Level.OFF: 0.0}


class Settings(Protocol):
    """The section of the file."""

    @property
    def hysteresis(self) -> float: ...
    @property
    def delay(self) -> float: ...
    @property
    def text(self) -> str: ...


def check_alarm(settings: Mapping[str, Any]) -> None:
    """Raises ValueError with what would be right."""
    given = [level for level in _RISING if settings[level] is not None]
    bits = [level for level in _OF_BITS if settings[level]]
    if not given and not bits:
        raise ValueError("an alarm needs a limit, such as high: 80, or for a bit on: true")
    if bits and (given or len(bits) > 1 or settings["hysteresis"]):
        raise ValueError("a bit has on: true or off: true, and no limit or hysteresis")
    for lower, upper in pairwise(given):
        if not settings[lower] < settings[upper]:
            raise ValueError(
                f"{lower} {settings[lower]:.15g} is not below {upper} {settings[upper]:.15g}"
            )
    below = [level for level in given if level in (Level.LOW_LOW, Level.LOW)]
    above = [level for level in given if level not in below]
    if below and above:
        gap = float(decimal(settings[above[0]]) - decimal(settings[below[-1]]))
        if settings["hysteresis"] >= gap:
            raise ValueError(
                f"hysteresis must be less than {gap:.15g}, the distance of {below[-1]} and"
                f" {above[0]}"
            )


def alarm_misfits(settings: Settings, kind: ValueType) -> Iterator[tuple[str, str]]:
    """Yields the mistake of an alarm that does not fit the type of its tag."""
    is_bit = kind.kind is Kind.BOOL
    has_bit = any(getattr(settings, level) for level in _OF_BITS)
    if is_bit and not has_bit:
        yield "alarm", "a bool has no limits: write on: true, or off: true"
    elif not is_bit and not kind.is_number:
        yield "alarm", f"a {kind} has no alarm: only numbers and bits have"
    elif not is_bit and has_bit:
        yield "alarm", f"a {kind} has limits, such as high: 80; only a bit has on and off"


def alarm_rule(settings: Settings | None, description: str) -> AlarmRule | None:
    """Returns the rule of a checked section."""
    if settings is None:
        return None
    limits = {
        level: float(limit) for level in _RISING if (limit := getattr(settings, level)) is not None
    }
    limits |= {level: value for level, value in _OF_BITS.items() if getattr(settings, level)}
    text = settings.text or description
    return AlarmRule(limits, settings.hysteresis, settings.delay, text)
