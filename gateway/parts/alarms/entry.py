"""One alarm of the board, with what surrounds its state: its condition, its timers, its parent."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass

import structlog

from gateway.parts.alarms.machine import (
    IN_ALARM,
    Acknowledgement,
    Alarm,
    Event,
    State,
    Status,
    Suppression,
)
from gateway.plant.doors import Reading
from gateway.tags import Tag

log: structlog.stdlib.BoundLogger = structlog.get_logger("gateway")

# What operators do.
AUDITED = (Event.ACKNOWLEDGED, Event.SHELVED, Event.UNSHELVED, Event.REMOVED, Event.PUT_BACK)
_UNKNOWN = Reading(None)


@dataclass(slots=True, eq=False)
class Entry:
    """One alarm. `key`: `device/tag`, `device`, or `line:name`. `tag`: None for the last two."""

    key: str
    alarm: Alarm
    tag: Tag | None = None
    look: Callable[[], Reading] | None = None  # only for lines and devices
    reading: Reading = _UNKNOWN  # what it returned last
    parent: str = ""  # the alarm of which it may be a part
    raised_at: float = -math.inf  # by the loop's clock
    own_from: float = -math.inf  # it is no part from then on, by the loop's clock
    released_at: float = math.inf  # the end of its shelving, by the loop's clock
    by: Acknowledgement | None = None  # who put it back; None: the time did
    counted: State = State.NORMAL
    timer: asyncio.TimerHandle | None = None  # of the delay

    @property
    def status(self) -> Status:
        return self.alarm.status

    @property
    def in_alarm(self) -> bool:
        return self.status.state in IN_ALARM

    @property
    def covers(self) -> bool:
        """True while the devices of a line are part of its alarm, also of a shelved one."""
        return self.in_alarm or (self.alarm.is_suppressed and self.alarm.reached is not None)

    @property
    def part_of(self) -> str:
        """The key of the alarm that it is a part of; empty: it is one of its own."""
        return self.parent if self.alarm.is_part and self.reading.alarm is not False else ""

    def operator(self, event: Event) -> Acknowledgement | Suppression | None:
        """Returns who did what `event` says; None: the end of a shelving by time, and others."""
        match event:
            case Event.ACKNOWLEDGED:
                return self.status.acknowledged
            case Event.SHELVED | Event.REMOVED:
                return self.status.suppressed
        return self.by if event in AUDITED else None

    @property
    def text(self) -> str:
        rule, level = self.alarm.rule, self.status.level
        return rule.text if level is None else rule.texts.get(level, rule.text)


def log_change(entry: Entry, event: Event) -> None:
    status = entry.status
    fields: dict[str, object] = {"alarm": entry.key, "state": status.state.value}
    if event in AUDITED:
        by = entry.operator(event)
        reason = {"reason": status.suppressed.reason} if status.suppressed is not None else {}
        log.info(f"alarm {event.value}", **fields, by=by and by.by, via=by and by.via, **reason)
        return
    fields["text"] = entry.text
    if entry.tag is not None:
        fields["value"] = status.value
    if entry.part_of:
        fields["part_of"] = entry.part_of
    if event is Event.RAISED:
        log.warning("alarm raised", **fields, limit=str(status.level))
    else:
        log.info(f"alarm {event.value}", **fields)
