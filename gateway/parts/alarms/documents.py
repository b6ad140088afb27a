"""The documents of alarms, and their order in lists."""

from collections.abc import Callable, Sequence

from gateway.contract import payload
from gateway.parts.alarms.board import Alarms
from gateway.parts.alarms.entry import AUDITED, Entry
from gateway.parts.alarms.machine import Event, State
from gateway.tags import Level, Priority, Quality, Sample, Tag
from gateway.tags.timestamps import rfc3339
from gateway.values import Value

_OF_BITS = {Level.ON: True, Level.OFF: False}
_WATCHED = (Level.OFFLINE, Level.DOWN, Level.SILENT, Level.STOPPED, Level.FAULT)
# The nearest word of the contract; `change` has the event itself.
_TOLD = {
    Event.FOLDED: Event.ENDED,
    Event.UNFOLDED: Event.RAISED,
    **dict.fromkeys((Event.SHELVED, Event.UNSHELVED, Event.REMOVED, Event.PUT_BACK), Event.ENDED),
}
_URGENT = [*Priority]
# The first alarms of a list: those that nobody has acknowledged.
_ORDER = {State.ACTIVE: 0, State.RETURNED: 1, State.ACKNOWLEDGED: 2, State.NORMAL: 3}


def alarm_fields(
    entry: Entry, sample: Callable[[Tag], Sample], parts: Sequence[Entry] = ()
) -> dict[str, object]:
    """Returns the document of an alarm. Any thread may call it."""
    status = entry.status
    level = None if status.state is State.NORMAL else status.level
    at_change: Value | None = status.value
    if entry.tag is not None:
        known: dict[str, object] = {**payload.sample_fields(sample(entry.tag))}
    else:
        alarm, why = entry.reading
        quality = Quality.BAD if alarm is None else Quality.GOOD
        value = None if alarm is None else bool(alarm)
        known = {"value": value, "quality": quality.value, **({"detail": why} if why else {})}
        at_change = None if at_change is None else bool(at_change)
    by = status.acknowledged
    return {
        "alarm": entry.key,
        "state": status.state.value,
        "level": None if level is None else level.value,
        "limit": _limit(entry, level),
        **known,
        "value_at_change": payload.loggable(at_change),
        "unit": "" if entry.tag is None else entry.tag.label.unit,
        "since": rfc3339(status.since) if status.since else None,
        "raised": rfc3339(status.raised) if status.raised else None,
        "acknowledged": by and {"by": by.by, "time": rfc3339(by.time), "via": by.via},
        "text": entry.text,
        "priority": entry.alarm.rule.priority.value,
        **({"part_of": entry.part_of} if entry.part_of else {}),
        **({"devices": [part.key for part in parts]} if parts else {}),
        **_suppressed(entry),
    }


def _limit(entry: Entry, level: Level | None) -> float | bool | None:
    if level is None or level in _WATCHED:
        return None
    return _OF_BITS.get(level, entry.alarm.rule.limits.get(level))


def _suppressed(entry: Entry) -> dict[str, object]:
    what = entry.status.suppressed
    if what is None:
        return {}
    known = {"by": what.by, "time": rfc3339(what.time), "reason": what.reason, "via": what.via}
    if what.until is None:
        return {"out_of_service": known}
    return {"shelved": {**known, "until": rfc3339(what.until)}}


def event_fields(entry: Entry, event: Event, fields: dict[str, object]) -> dict[str, object]:
    """Returns the document of a change, from that of the alarm."""
    told = {"event": _TOLD.get(event, event).value, **fields}
    if event in _TOLD:
        told["change"] = event.value
    if event in AUDITED and event is not Event.ACKNOWLEDGED:
        by = entry.operator(event)
        told |= {"by": by and by.by, "via": by and by.via}
    return told


def open_alarms(alarms: Alarms) -> list[Entry]:
    """Returns the alarms that are not normal: those without acknowledgement first, then by
    priority, then the newest."""

    def place(entry: Entry) -> tuple[int, int, int]:
        status, urgent = entry.status, _URGENT.index(entry.alarm.rule.priority)
        return _ORDER[status.state], urgent, -status.since

    return sorted(alarms.tally.open.values(), key=place)


def suppressed_alarms(alarms: Alarms) -> list[Entry]:
    """Returns the alarms that are shelved or out of service: the latest first."""
    found = [one for one in alarms.tally.kept() if one.status.suppressed is not None]
    return sorted(found, key=lambda entry: -entry.status.since)
