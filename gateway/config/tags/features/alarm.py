"""The alarm of a tag: its limits, which belong together, and which tag can have them."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Literal, Self

from pydantic import model_validator

from gateway.config.settings.session_model import Section
from gateway.config.settings.setting_types import Distance, Duration, Finite, Text
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings, for_one
from gateway.tags import AlarmRule, Level, Priority
from gateway.tags.scaling import decimal
from gateway.values import Kind

_RISING = (Level.LOW_LOW, Level.LOW, Level.HIGH, Level.HIGH_HIGH)
_OF_BITS = {Level.ON: 1.0, Level.OFF: 0.0}


class AlarmSection(Section):
    """The alarm of a number or a bit: docs/alarms.md."""

    high_high: Finite | None = None
    """A value from here on is in alarm, of the worse level."""
    high: Finite | None = None
    """A value from here on is in alarm."""
    low: Finite | None = None
    """A value from here downwards is in alarm."""
    low_low: Finite | None = None
    """A value from here downwards is in alarm, of the worse level."""
    on: bool = False
    """A bit is in alarm while it is on."""
    off: bool = False
    """A bit is in alarm while it is off."""
    hysteresis: Distance = 0.0
    """A limit is left when the value is so far from it, in the unit of the tag."""
    delay: Duration = 0.0
    """A limit counts when it is reached for so long."""
    off_delay: Duration = 0.0
    """It counts until it is left for so long."""
    priority: Literal["critical", "high", "medium", "low"] = "medium"
    """The priority of the alarm: how soon an operator must act."""
    text: Text = ""
    """A sentence for people; left out: the description of the tag."""

    @model_validator(mode="after")
    def _together(self) -> Self:
        limits = {level: limit for level in _RISING if (limit := getattr(self, level)) is not None}
        bits = [level for level in _OF_BITS if getattr(self, level)]
        if not limits and not bits:
            raise ValueError("an alarm needs a limit, such as high: 80, or for a bit on: true")
        if bits and (limits or len(bits) > 1 or self.hysteresis):
            raise ValueError("a bit has on: true or off: true, and no limit or hysteresis")
        for lower, upper in pairwise(limits):
            if not limits[lower] < limits[upper]:
                raise ValueError(
                    f"{lower} {limits[lower]:.15g} is not below {upper} {limits[upper]:.15g}"
                )
        below = [level for level in limits if level in (Level.LOW_LOW, Level.LOW)]
        above = [level for level in limits if level not in below]
        if below and above:
            gap = float(decimal(limits[above[0]]) - decimal(limits[below[-1]]))
            if self.hysteresis >= gap:
                raise ValueError(
                    f"hysteresis must be less than {gap:.15g}, the distance of {below[-1]} and"
                    f" {above[0]}"
                )
        return self


class AlarmSettings(Settings):
    alarm: AlarmSection | None = None
    """Raise an alarm at a limit of the value, or while a bit is on."""


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    if own.alarm is None:
        return
    kind, is_bit = facts.kind, facts.kind.kind is Kind.BOOL
    has_bit = own.alarm.on or own.alarm.off
    if facts.area is not None and not facts.area.readable:
        yield (
            "alarm",
            f"{facts.name} is never read at station {facts.station}: it can have no alarm",
        )
    field, rule = facts.field, facts.write
    never = field is not None and not (field.polled or field.unsolicited)
    if never or (rule is not None and not rule.polled):
        yield "alarm", f"{facts.name} can only be written: it can have no alarm"
    if kind.count:
        yield from for_one(own, kind, "alarm")
    elif is_bit and not has_bit:
        yield "alarm", "a bool has no limits: write on: true, or off: true"
    elif not is_bit and not kind.is_number:
        yield "alarm", f"a {kind} has no alarm: only numbers and bits have"
    elif not is_bit and has_bit:
        yield "alarm", f"a {kind} has limits, such as high: 80; only a bit has on and off"


def _make(own: Any, facts: Facts) -> AlarmRule | None:
    section = own.alarm
    if section is None:
        return None
    limits = {
        level: float(limit) for level in _RISING if (limit := getattr(section, level)) is not None
    }
    limits |= {level: value for level, value in _OF_BITS.items() if getattr(section, level)}
    text = section.text or facts.settings.description
    delays = section.delay, section.off_delay
    return AlarmRule(limits, section.hysteresis, *delays, Priority(section.priority), text)


FEATURE = Feature(own=AlarmSettings, computed=frozenset({"alarm"}), check=_check, make=_make)
