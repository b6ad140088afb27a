"""Publishing of a tag: deadband, heartbeat, form of the payload, history, events."""

import math
import re
from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, Any

from gateway.config.messages import shown
from gateway.config.settings.setting_types import Interval, Parsed, member
from gateway.config.tags.features.feature import Facts, Feature, Problem, Settings, for_numbers
from gateway.errors import ConfigError
from gateway.tags import Deadband, Form, Publish, Publishing, Tag

_PERCENT = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?%\Z")
_DEADBAND_SCHEMA = {
    "anyOf": [
        {"type": "number", "minimum": 0},
        {"type": "string", "pattern": r"^[0-9]+(\.[0-9]+)? ?%$"},
    ]
}


def _deadband(text: object) -> Deadband:
    """Parses `0.5` (in the unit of the tag) or `2%` (of the last published value)."""
    if isinstance(text, (int, float)) and not isinstance(text, bool):
        if not 0 <= text < math.inf:
            raise ConfigError(f"{shown(text)}: a deadband is 0 or more")
        return Deadband(float(text))
    match = _PERCENT.match(text) if isinstance(text, str) else None
    if match is None:
        raise ConfigError(f"{shown(text)} is no deadband: write 0.5 (in the unit of the tag) or 2%")
    if float(match[1]) > 100:
        raise ConfigError(f"{text}: more than 100% would publish almost nothing")
    return Deadband(float(match[1]), percent=True)


class PublishingSettings(Settings):
    deadband: Annotated[Deadband | None, Parsed(_deadband, _DEADBAND_SCHEMA)] = None
    """A smaller change is not published: 0.5 (in the tag's unit) or 2%."""
    publish: Annotated[Publish, member(Publish)] = Publish.CHANGE
    """Publish when the value changes, or every value that is read."""
    heartbeat: Interval | None = None
    """Publish at least this often, changed or not."""
    history: bool = False
    """Store the values on disk."""
    payload: Annotated[Form, member(Form)] = Form.JSON
    """json: value, quality and time; raw: the bare value as text."""


class EventSettings(Settings):
    event: bool = False
    """Publish every frame, even with the same value as the last: a bar code."""


def _check(own: Any, facts: Facts) -> Iterator[Problem]:
    yield from for_numbers(own, facts.kind, "deadband")
    if "event" not in own.model_fields_set or not own.event:
        return
    if facts.field is None:
        yield "event", f"{facts.name} is polled: only an unsolicited value can be an event"
    elif not facts.field.unsolicited:
        hint = f": {facts.field.event_hint}" if facts.field.event_hint else ""
        yield "event", f"{facts.name} never arrives unsolicited{hint}"


def _make(own: Any, facts: Facts) -> Publishing:
    settings = facts.settings
    named = getattr(own, "enum", None) is not None
    band = settings.deadband if facts.kind.is_number and not named else None
    if getattr(own, "event", False):
        heartbeat = None
        return _shared(band, Publish.ALWAYS, heartbeat, settings.payload, settings.history, True)
    return _shared(
        band, settings.publish, settings.heartbeat, settings.payload, settings.history, False
    )


_shared = lru_cache(maxsize=4096)(Publishing)  # one object for all that are equal


def _meta(tag: Tag) -> dict[str, object]:
    rule, band = tag.publishing, tag.publishing.deadband
    return {
        "publish": rule.publish.value,
        "deadband": None if band is None else {"amount": band.amount, "percent": band.percent},
        "heartbeat": rule.heartbeat,
        "history": rule.history,
        "payload": rule.payload.value,
        "event": rule.event,
    }


FEATURE = Feature(
    defaults=PublishingSettings,
    own=EventSettings,
    computed=frozenset({"deadband", "history", "payload"}),
    check=_check,
    make=_make,
    slot="publishing",
    meta=_meta,
)
