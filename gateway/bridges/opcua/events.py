"""Alarms of the gateway as events of OPC UA: Alarms & Conditions."""

import itertools
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from asyncua import ua

Type, Ids = ua.VariantType, ua.ObjectIds
SEVERITIES = {"critical": 900, "high": 700, "medium": 500, "low": 300}
SERVER = ua.NodeId(Ids.Server)
_CONDITIONS = (Ids.BaseEventType, Ids.ConditionType, Ids.AcknowledgeableConditionType)
_ALARM = ua.NodeId(Ids.AlarmConditionType)
_REFRESH = {
    begin: ua.NodeId(kind)
    for begin, kind in ((True, Ids.RefreshStartEventType), (False, Ids.RefreshEndEventType))
}
_BASE = ua.NodeId(Ids.BaseEventType)
SUPERTYPES = {
    _ALARM: {_ALARM, *map(ua.NodeId, _CONDITIONS)},
    **{kind: {kind, _BASE, ua.NodeId(Ids.SystemEventType)} for kind in _REFRESH.values()},
}
_numbers = itertools.count(time.time_ns())


class Event:
    """An event with its fields by name, such as `ActiveState/Id`."""

    emitting_node = SERVER

    def __init__(self, kind: ua.NodeId, fields: dict[str, ua.Variant]) -> None:
        self.EventType = kind  # asyncua's name
        now = ua.Variant(datetime.now(UTC), Type.DateTime)
        number = next(_numbers)
        self._fields = {
            "EventId": ua.Variant(b"%d" % number, Type.ByteString),
            "EventType": ua.Variant(kind, Type.NodeId),
            "SourceNode": ua.Variant(SERVER, Type.NodeId),
            "SourceName": ua.Variant("Server", Type.String),
            "Time": now,
            "ReceiveTime": now,
            "Message": ua.Variant(ua.LocalizedText(""), Type.LocalizedText),
            "Severity": ua.Variant(1, Type.UInt16),
        } | fields

    def field(self, clause: ua.SimpleAttributeOperand) -> ua.Variant:
        """Returns a field that a client selects; of one that the event lacks, an empty variant."""
        path = "/".join(str(part.Name) for part in clause.BrowsePath or ())
        if not path:  # of a condition: its node
            path = "ConditionId" if clause.AttributeId == ua.AttributeIds.NodeId else ""
        return self._fields.get(path, ua.Variant())

    def to_event_fields(self, clauses: list[ua.SimpleAttributeOperand]) -> list[ua.Variant]:
        return [self.field(clause) for clause in clauses]


def refresh(begins: bool) -> Event:
    """The event around those of a refresh."""
    return Event(_REFRESH[begins], {})


def event_id(document: Mapping[str, Any]) -> bytes:
    """Identifies the event that an operator saw: also after a restart of the bridge."""
    return f"{document['alarm']}\n{document['raised'] or ''}\n{next(_numbers)}".encode()


def raised_of(event: bytes, alarm: str) -> str | None:
    """Returns when the alarm of an event was raised; None: it is no event of this alarm."""
    name, _, rest = event.decode("utf-8", "replace").partition("\n")
    return rest.partition("\n")[0] if name == alarm else None


def of_alarm(
    document: Mapping[str, Any], condition: ua.NodeId, source: ua.NodeId, quality: int
) -> Event:
    """Returns the event of an alarm as it is now. `quality`: a status code, bad while it is not
    known whether the alarm is still so."""
    state, level = document["state"], document["level"]
    is_active, is_acked = state in ("active", "acknowledged"), state in ("acknowledged", "normal")
    is_shelved, is_out = "shelved" in document, "out_of_service" in document
    acked = document["acknowledged"] or {}
    since = _time(document["since"] or document.get("time"))
    parts = [document["text"] or document["alarm"], level and level.replace("_", " ")]
    message = ": ".join(filter(None, [*parts, document.get("detail")]))
    fields = {
        "EventId": ua.Variant(event_id(document), Type.ByteString),
        "SourceNode": ua.Variant(source, Type.NodeId),
        "SourceName": _text(document["alarm"]),
        "InputNode": ua.Variant(source, Type.NodeId),
        "ConditionId": ua.Variant(condition, Type.NodeId),
        "ConditionName": _text(document["alarm"]),
        "ConditionClassId": ua.Variant(ua.NodeId(Ids.ProcessConditionClassType), Type.NodeId),
        "ConditionClassName": _local("ProcessConditionClassType"),
        "BranchId": ua.Variant(ua.NodeId(), Type.NodeId),
        "Time": since,
        "Message": _local(message),
        "Severity": ua.Variant(SEVERITIES.get(document.get("priority", ""), 500), Type.UInt16),
        "Retain": _is(not is_acked or is_active),
        "Quality": ua.Variant(ua.StatusCode(ua.UInt32(quality)), Type.StatusCode),
        "Comment": _local(""),
        "ClientUserId": _text(acked.get("by") or ""),
        **_state("EnabledState", not is_out, "Enabled", "Disabled"),
        **_state("ActiveState", is_active, "Active", "Inactive"),
        **_state("AckedState", is_acked, "Acknowledged", "Unacknowledged"),
        **_state("SuppressedState", is_out, "Suppressed", "Unsuppressed"),
        **_state("OutOfServiceState", is_out, "Out of Service", "In Service"),
        "SuppressedOrShelved": _is(is_shelved or is_out),
        "ShelvingState/CurrentState": _local("TimedShelved" if is_shelved else "Unshelved"),
        "ActiveState/EffectiveDisplayName": _local(level or state),
        "ActiveState/TransitionTime": since,
    }
    if "time" in acked:
        fields["AckedState/TransitionTime"] = _time(acked["time"])
    return Event(_ALARM, fields)


def _state(name: str, is_so: bool, yes: str, no: str) -> dict[str, ua.Variant]:
    return {name: _local(yes if is_so else no), f"{name}/Id": _is(is_so)}


def _is(value: bool) -> ua.Variant:
    return ua.Variant(value, Type.Boolean)


def _text(text: str) -> ua.Variant:
    return ua.Variant(text, Type.String)


def _local(text: str) -> ua.Variant:
    return ua.Variant(ua.LocalizedText(text), Type.LocalizedText)


def _time(text: str | None) -> ua.Variant:
    time = datetime.fromisoformat(text).astimezone(UTC) if text else datetime.now(UTC)
    return ua.Variant(time, Type.DateTime)
