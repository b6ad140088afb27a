"""The documents of alarms, and the acknowledgement of an operator as it is sent."""

from collections.abc import Callable

import orjson

from gateway.contract import payload
from gateway.errors import BadValue
from gateway.parts.alarms.board import Alarms, Entry
from gateway.parts.alarms.machine import State
from gateway.tags import Level, Quality, Sample, Tag
from gateway.tags.timestamps import rfc3339

LONGEST_NAME = 100  # characters of an operator's name
_LONGEST = 2000  # bytes of an acknowledgement
_OF_BITS = {Level.ON: True, Level.OFF: False}
_WATCHED = (Level.OFFLINE, Level.DOWN, Level.STOPPED)
# The first alarms of a list: those that nobody has acknowledged.
_ORDER = {State.ACTIVE: 0, State.RETURNED: 1, State.ACKNOWLEDGED: 2, State.NORMAL: 3}


def alarm_fields(entry: Entry, sample: Callable[[Tag], Sample]) -> dict[str, object]:
    """Returns the document of an alarm. Any thread may call it."""
    status, rule = entry.status, entry.alarm.rule
    if entry.tag is not None:
        known: dict[str, object] = {**payload.sample_fields(sample(entry.tag))}
    else:
        alarm, why = entry.reading
        quality = Quality.BAD if alarm is None else Quality.GOOD
        known = {"value": alarm, "quality": quality.value, **({"detail": why} if why else {})}
    by = status.acknowledged
    return {
        "alarm": entry.key,
        "state": status.state.value,
        "level": None if status.level is None else status.level.value,
        "limit": _limit(entry, status.level),
        **known,
        "value_at_change": payload.loggable(status.value),
        "unit": "" if entry.tag is None else entry.tag.label.unit,
        "since": rfc3339(status.since) if status.since else None,
        "raised": rfc3339(status.raised) if status.raised else None,
        "acknowledged": by and {"by": by.by, "time": rfc3339(by.time), "via": by.via},
        "text": rule.text,
    }


def _limit(entry: Entry, level: Level | None) -> float | bool | None:
    if level is None or level in _WATCHED:
        return None
    return _OF_BITS.get(level, entry.alarm.rule.limits.get(level))


def open_alarms(alarms: Alarms) -> list[Entry]:
    """Returns the alarms that are not normal: those without acknowledgement first, then the
    newest."""
    found = list(alarms.open.values())
    return sorted(found, key=lambda entry: (_ORDER[entry.status.state], -entry.status.since))


def parse_acknowledgement(data: bytes) -> tuple[str, str | None]:
    """Returns the operator's name, and the `raised` that the operator saw. Raises `BadValue`."""
    meant = 'send {"by": "the operator\'s name"}'
    if len(data) > _LONGEST:
        raise BadValue(f"the payload has {len(data)} bytes, more than {_LONGEST}")
    try:
        found = orjson.loads(data)
    except orjson.JSONDecodeError:
        raise BadValue(f"the payload is no JSON: {meant}") from None
    if not isinstance(found, dict) or not found.keys() <= {"by", "raised"}:
        raise BadValue(f"the payload is no acknowledgement: {meant}")
    by, raised = found.get("by"), found.get("raised")
    if not isinstance(by, str) or not by.strip():
        raise BadValue(f"the name of the operator is missing: {meant}")
    if len(by) > LONGEST_NAME or not by.isprintable():
        raise BadValue(f"the name of the operator is longer than {LONGEST_NAME}, or not printable")
    if raised is not None and not isinstance(raised, str):
        raise BadValue("raised is no time: send it as the alarm's document has it")
    return by.strip(), raised
