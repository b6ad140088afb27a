"""The shapes of the answers of the JSON API: the documents of Zenoh, and lists of them."""

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from gateway.contract.documents.catalogue import described

Schema = dict[str, Any]

TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}
INTEGER: Schema = {"type": "integer"}


def ref(name: str) -> Schema:
    """Refers to one of `SCHEMAS`."""
    return {"$ref": f"#/components/schemas/{name}"}


def _about(schema: Schema, about: str) -> Schema:
    return {**schema, "description": about}


def _list(of: Schema) -> Schema:
    return {"type": "array", "items": of}


def _by_name(of: Schema) -> Schema:
    return {"type": "object", "additionalProperties": of}


def _record(needed: Mapping[str, Schema], others: Mapping[str, Schema] | None = None) -> Schema:
    """An object with the fields `needed`, and perhaps the `others`."""
    properties = {**needed, **(others or {})}
    return {"type": "object", "properties": properties, "required": [*needed]}


def _both(name: str, **more: Schema) -> Schema:
    """A document of Zenoh with more fields."""
    return {"allOf": [ref(name), _record(more)]}


_NEXT = _about({"type": ["string", "null"]}, "`after` of the next page; null: this was the last")
_SAMPLE: Schema = {"anyOf": [*map(ref, ("KnownValue", "UncertainValue", "UnknownValue"))]}
_OF_ROUTES = (
    *("DeviceDocument", "AlarmDocument", "AcknowledgeRequest", "WrittenDocument"),
    *("DoorDocument", "DoorRequest"),
)
_CODED = _record(dict.fromkeys(("code", "text", "about"), TEXT))
_OWN: Mapping[str, Schema] = {
    "Error": _record({"error": TEXT}),
    "Failure": {"anyOf": [ref("FailureDocument"), ref("GroupDocument")]},
    "Status": _record(
        {
            "status": ref("StatusDocument"),
            "zenoh": ref("ZenohDocument"),
            "outcomes": ref("OutcomesDocument"),
            **dict.fromkeys(("faults", "warnings"), _list(TEXT)),
            "coded": _record(dict.fromkeys(("faults", "warnings"), _list(_CODED))),
        },
        {
            "history": ref("HistoryDocument"),
            "standby": ref("StandbyDocument"),
            "alarms": ref("AlarmCounts"),
        },
    ),
    "Lines": _record({"lines": _by_name(ref("LineDocument"))}),
    "Devices": _record({"devices": _by_name(ref("Device")), "next": _NEXT}),
    "Transfers": _record(
        {"transfers": _list(_both("TransferDocument", transfer=INTEGER)), "next": _NEXT}
    ),
    "Tags": _record(
        {
            "tags": _list(ref("Tag")),
            "next": _NEXT,
            "total": _about(INTEGER, "Tags of the whole list"),
        }
    ),
    "Tag": {
        **_both(
            "MetaDocument",
            tag=_about(TEXT, "device/name"),
            value=_about({}, "null when bad"),
            quality={"enum": ["good", "uncertain", "bad"]},
            time=_about(TEXT, "UTC"),
            alarm=_about({"type": ["object", "null"]}, "Its limits by level; null: it has none"),
        ),
        "description": "The description, the fields of the value, and the alarm",
    },
    "History": _record(
        {
            "tag": TEXT,
            "complete": _about(FLAG, "false: ask again from the time of the last sample"),
        },
        {
            "samples": _list(_SAMPLE),
            "buckets": _about(
                _list(ref("BucketDocument")), "Instead of samples, if `bucket` was asked for"
            ),
        },
    ),
    "Fleet": _record(
        {
            "time": _about(TEXT, "UTC, when the gateways were asked"),
            "took": _about({"type": "number"}, "Seconds until all had replied"),
            "gateways": _list(
                _about(
                    _record({"gateway": TEXT, "state": TEXT, "says": TEXT}),
                    "With the fields of its report, if it replied",
                )
            ),
            "mistakes": _list(TEXT),
        }
    ),
    "PastAlarms": _record({"alarms": _list(ref("AlarmEvent"))}),
    "Alarms": _record(
        {"alarms": _list(ref("AlarmDocument")), "counts": ref("AlarmCounts"), "next": _NEXT}
    ),
}


def _with_documents(own: Mapping[str, Schema]) -> Mapping[str, Schema]:
    """Adds the types that `own` refers to, and those that they refer to."""
    text = described().decode().replace("#/$defs/", "#/components/schemas/")
    documents: Mapping[str, Schema] = json.loads(text)["$defs"]
    # A list of devices leaves out the requests of each.
    device = documents["DeviceDocument"]
    needed = [name for name in device["required"] if name != "requests"]
    found = {**own, "Device": {**device, "required": needed}}
    waiting = {*_OF_ROUTES, *_references(found.values())} - found.keys()
    while waiting:
        found |= {name: documents[name] for name in waiting}
        waiting = _references(documents[name] for name in waiting) - found.keys()
    return found


def _references(schemas: Iterable[Schema]) -> set[str]:
    return set(re.findall(r"#/components/schemas/(\w+)", json.dumps([*schemas])))


SCHEMAS = _with_documents(_OWN)
