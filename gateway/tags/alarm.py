"""The alarm of a tag, as the file describes it: limits, hysteresis, delay."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class Priority(StrEnum):
    """The priority of an alarm: how soon an operator must act."""

    CRITICAL = "critical"
    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"


class Level(StrEnum):
    """The kinds of limits. Of one side the worse one comes first."""

    HIGH_HIGH = "high_high"
    HIGH = "high"
    LOW_LOW = "low_low"
    LOW = "low"
    ON = "on"
    OFF = "off"
    OFFLINE = "offline"  # of a device
    DOWN = "down"  # of a line
    SILENT = "silent"  # of a line: none of its devices replies
    STOPPED = "stopped"  # of a transfer
    FAULT = "fault"  # of the gateway itself


BELOW = frozenset({Level.LOW, Level.LOW_LOW, Level.OFF})  # reached from above


@dataclass(frozen=True, slots=True)
class AlarmRule:
    """A limit is reached at its value, and left when the value is `hysteresis` away from it. It
    counts after `delay` seconds, until it was left for `off_delay` seconds."""

    limits: Mapping[Level, float]  # a bit has one limit: its value in alarm
    hysteresis: float = 0.0
    delay: float = 0.0
    off_delay: float = 0.0
    priority: Priority = Priority.MEDIUM
    text: str = ""  # for people
    texts: Mapping[Level, str] = field(default_factory=dict)  # of levels with another text
