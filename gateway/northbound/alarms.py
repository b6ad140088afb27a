"""Alarms on Zenoh: their documents, their publication, and the acknowledgement of an operator."""

import asyncio
import time
from collections.abc import Callable
from typing import Protocol

import orjson

from gateway.contract import payload
from gateway.contract.interfaces import History, Plant
from gateway.contract.keys import Keys
from gateway.contract.payload import Failure, Problem, WriteOutcome
from gateway.contract.writers import NotAllowed, Repeated
from gateway.errors import BadValue, GatewayError
from gateway.northbound.publishing.publisher import Publisher
from gateway.northbound.requests.acceptance import Acceptance, Sender
from gateway.northbound.requests.audit import Audit
from gateway.parts.alarms import Alarms, Entry, Event, NothingToAcknowledge, State
from gateway.tags import Level, Quality, Sample, Tag
from gateway.tags.timestamps import rfc3339

LONGEST_NAME = 100  # characters of an operator's name
_LONGEST = 2000  # bytes of an acknowledgement
_BATCH_SIZE = 500  # alarms in one turn of the loop
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
        "unit": "" if entry.tag is None else entry.tag.unit,
        "since": rfc3339(status.since) if status.since else None,
        "raised": rfc3339(status.raised) if status.raised else None,
        "acknowledged": by and {"by": by.by, "time": rfc3339(by.time), "via": by.via},
        "text": rule.text,
    }


class Alarmed(Protocol):
    """A plant with its alarms."""

    @property
    def alarms(self) -> Alarms: ...


def _limit(entry: Entry, level: Level | None) -> float | bool | None:
    if level is None or level in _WATCHED:
        return None
    return _OF_BITS.get(level, entry.alarm.rule.limits.get(level))


def open_alarms(plant: Alarmed) -> list[Entry]:
    """Returns the alarms that are not normal: those without acknowledgement first, then the
    newest."""
    found = list(plant.alarms.open.values())
    return sorted(found, key=lambda entry: (_ORDER[entry.status.state], -entry.status.since))


class AlarmPublisher:
    """Publishes each change, and records it in history. On the event loop; never blocks."""

    def __init__(
        self, keys: Keys, plant: Plant, publisher: Publisher, history: History | None
    ) -> None:
        self._keys = keys
        self._plant = plant
        self._publisher = publisher
        self._history = history
        plant.alarms.subscribe(self.changed)

    def changed(self, entry: Entry, event: Event | None) -> None:
        """`event` None: only the quality of the value has changed."""
        self._publish(entry)
        if event is not None and self._history is not None:
            fields = {"event": event.value, **alarm_fields(entry, self._plant.sample)}
            self._history.record_alarm(entry.status.since, payload.document(fields).decode())

    async def publish_all(self) -> None:
        entries = list(self._plant.alarms.entries.values())
        for start in range(0, len(entries), _BATCH_SIZE):
            for entry in entries[start : start + _BATCH_SIZE]:
                self._publish(entry)
            await asyncio.sleep(0)

    def _publish(self, entry: Entry) -> None:
        """The publishing thread makes the document: a line that is lost changes many at once."""

        def document() -> bytes:
            return payload.document(alarm_fields(entry, self._plant.sample))

        self._publisher.latest(self._keys.alarm(entry.key), document)


class Acknowledgements:
    """Acknowledges for operators, by the rules of writes."""

    def __init__(self, keys: Keys, plant: Plant, audit: Audit, acceptance: Acceptance) -> None:
        """`audit` gets each refusal."""
        self._keys = keys
        self._plant = plant
        self._audit = audit
        self._acceptance = acceptance

    def acknowledge(self, key: str, data: bytes, sender: Sender) -> bytes | Failure:
        """Returns the document of the alarm. `key`, `data`: as received."""
        try:
            via = self._acceptance.accept(key, data, sender).by
            by, raised = parse_acknowledgement(data)
            entry = self._plant.alarms.entries.get(self._name(key))
            if entry is None:
                return self._refused(key, Problem.UNKNOWN_TAG, f"there is no alarm at {key}")
            seen = entry.status.raised
            if raised is not None and raised != rfc3339(seen):
                seen = -1
            self._plant.alarms.acknowledge(entry.key, by, via, None if raised is None else seen)
            return payload.document(alarm_fields(entry, self._plant.sample))
        except NothingToAcknowledge as error:
            return self._refused(key, Problem.NOTHING_TO_ACKNOWLEDGE, str(error))
        except (NotAllowed, Repeated) as error:
            return self._refused(key, Problem.NOT_ALLOWED, str(error))
        except GatewayError as error:
            failure = payload.failure(error)
            return self._refused(key, failure.problem, failure.reason)

    def _name(self, key: str) -> str:
        """Raises `BadValue`."""
        if "*" in key:
            raise BadValue(f"{payload.short(key)} has a wildcard: an acknowledgement names one")
        return key.removeprefix(self._keys.alarm(""))

    def _refused(self, key: str, problem: Problem, reason: str) -> Failure:
        failure = Failure(problem, reason)
        self._audit(WriteOutcome(key, None, failure, time.time_ns(), 0.0, command=True))
        return failure


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
