"""The shapes of the answers of the JSON API, as JSON schema."""

from collections.abc import Mapping
from typing import Any

from gateway.tags import Level

Schema = dict[str, Any]

TEXT: Schema = {"type": "string"}
FLAG: Schema = {"type": "boolean"}
NUMBER: Schema = {"type": "number"}
INTEGER: Schema = {"type": "integer"}
OBJECT: Schema = {"type": "object"}
ANY: Schema = {}


def ref(name: str) -> Schema:
    """Refers to one of `SCHEMAS`."""
    return {"$ref": f"#/components/schemas/{name}"}


def choice(*known: str | None) -> Schema:
    return {"enum": [*known]}


def _either(*kinds: str, about: str = "") -> Schema:
    return _about({"type": [*kinds]}, about)


def _about(schema: Schema, about: str) -> Schema:
    return {**schema, "description": about} if about else schema


def _list(name: str, about: str = "") -> Schema:
    return _about({"type": "array", "items": ref(name)}, about)


def _by_name(of: Schema, about: str = "") -> Schema:
    return _about({"type": "object", "additionalProperties": of}, about)


def _record(
    needed: Mapping[str, Schema], others: Mapping[str, Schema] | None = None, *, more: bool = False
) -> Schema:
    """An object with the fields `needed`, perhaps the `others`; `more`: and fields that are not
    described."""
    properties = {**needed, **(others or {})}
    closed = {} if more else {"additionalProperties": False}
    return {"type": "object", "properties": properties, "required": [*needed], **closed}


_STATUS_DOCUMENT = "A status document: see docs/status.md"
_TEXT_OR_NULL = _either("string", "null")
_NUMBER_OR_NULL = _either("number", "null")
_OBJECT_OR_NULL = _either("object", "null")
_SCALAR = ("number", "boolean", "string")
_VALUE: Schema = {
    "type": ["boolean", "number", "string", "array", "null"],
    "items": {"type": ["boolean", "number"]},
    "description": "null when bad; a list for an array. Integers may be larger than 2^53.",
}
_TEXTS: Schema = {"type": "array", "items": TEXT}
_QUALITY = choice("good", "bad")
_NAME_OF_VALUE = _about(TEXT, "The name of the value, where `enum` has one")
_NEXT = _about(_TEXT_OR_NULL, "`after` of the next page; null: this was the last")
_SAMPLE = {"value": _VALUE, "quality": _QUALITY, "time": _about(TEXT, "UTC")}
_ORIGIN = _about(choice("simulated", "computed", None), "null or absent: a plain reading")
_SAMPLE_MORE = {
    "text": _NAME_OF_VALUE,
    "reason": _TEXT_OR_NULL,
    "detail": TEXT,
    "origin": _ORIGIN,
    "limited": _about(choice("low", "high"), "At this end of its clamp"),
}

SCHEMAS: Mapping[str, Schema] = {
    "Error": _record({"error": TEXT}, more=True),
    "Failure": _record(
        {"error": _about(TEXT, "A word of docs/zenoh.md#a-write")},
        {
            "code": _TEXT_OR_NULL,
            "reason": TEXT,
            "tags": _by_name(
                {"anyOf": [ref("Written"), ref("Failure")]},
                "Of several tags: the outcome of each",
            ),
            "took": NUMBER,
        },
        more=True,
    ),
    "Status": _record(
        {
            **dict.fromkeys(("status", "zenoh", "outcomes"), OBJECT),
            **dict.fromkeys(("faults", "warnings"), _TEXTS),
        },
        {"history": OBJECT, "standby": OBJECT, "alarms": _by_name(INTEGER)},
    ),
    "Lines": _record({"lines": _by_name(ref("Line"))}),
    "Line": _about(
        _record(
            {
                "open": FLAG,
                "trouble": TEXT,
                **dict.fromkeys(("devices", "measured", "expected"), ANY),
            },
            {"calls": ref("Calls")},
            more=True,
        ),
        _STATUS_DOCUMENT,
    ),
    "Calls": {
        **_record(
            {
                "state": choice("idle", "dialling", "connected"),
                "since": _about(_NUMBER_OR_NULL, "Seconds in this state"),
                "next": _about(_NUMBER_OR_NULL, "Seconds until the next call"),
                **dict.fromkeys(("made", "failed", "in_a_row"), INTEGER),
                "last_result": TEXT,
                "results": _by_name(INTEGER),
            },
            more=True,
        ),
        **_about(_OBJECT_OR_NULL, "Telephone calls of a line with a modem: see docs/status.md"),
    },
    "Devices": _record({"devices": _by_name(ref("Device")), "next": _NEXT}),
    "Device": _about(
        _record(
            {
                "protocol": TEXT,
                "standing": choice("starting", "up", "failing", "silent"),
                "diagnosis": _about(TEXT, "Likely cause of a fault, as a sentence"),
            },
            {"identity": _about(_OBJECT_OR_NULL, "What it told of itself; null: not asked")},
            more=True,
        ),
        _STATUS_DOCUMENT,
    ),
    "Transfers": _record({"transfers": _list("Transfer"), "next": _NEXT}),
    "Transfer": _about(
        _record(
            {
                "transfer": {"type": "integer", "minimum": 1},
                **dict.fromkeys(("from", "to", "when"), TEXT),
                "state": choice("starting", "carried", "stale", "waiting", "refused", "unclear"),
                "code": choice("0", "5", "A", "B", None),
                "meaning": _about(TEXT, "The code in the words of the manuals"),
                "why": _about(TEXT, "Why it does not carry"),
                "value": _about(ANY, "The value that the target acknowledged last"),
                "time": _TEXT_OR_NULL,
                "last_carried": _about(
                    _NUMBER_OR_NULL, "Seconds since the target acknowledged a value"
                ),
                "age": _about(_NUMBER_OR_NULL, "Seconds since the last good read of the source"),
                **dict.fromkeys(("carried", "not_done", "refused", "unclear"), INTEGER),
            },
            more=True,
        ),
        _STATUS_DOCUMENT,
    ),
    "Tags": _record(
        {
            "tags": _list("Tag"),
            "next": _NEXT,
            "total": _about(INTEGER, "Tags of the whole list"),
        }
    ),
    "Tag": {
        **_record(
            {
                "tag": _about(TEXT, "device/name"),
                **_SAMPLE,
                **dict.fromkeys(("type", "address", "unit", "description"), TEXT),
                "every": NUMBER,
                "history": FLAG,
                "write": _about(_OBJECT_OR_NULL, "null: it cannot be written"),
                "alarm": _about(_OBJECT_OR_NULL, "Its limits by level; null: it has none"),
            },
            {
                **_SAMPLE_MORE,
                **dict.fromkeys(("raw_type", "publish", "payload"), TEXT),
                **dict.fromkeys(("scale", "offset"), NUMBER),
                **dict.fromkeys(("invert", "event"), FLAG),
                **dict.fromkeys(("debounce", "heartbeat"), _NUMBER_OR_NULL),
                **dict.fromkeys(("clamp", "counter", "enum", "deadband"), _OBJECT_OR_NULL),
                **dict.fromkeys(("from", "to"), _either("array", "null")),
                "length": _about(_either("integer", "null"), "Elements of an array"),
                "decimals": _either("integer", "null"),
                "computed": _TEXT_OR_NULL,
            },
            more=True,
        ),
        "description": "The value, and the fields of its `@meta`: see docs/zenoh.md",
    },
    "Sample": _record(_SAMPLE, _SAMPLE_MORE),
    "History": _record(
        {
            "tag": TEXT,
            "complete": _about(FLAG, "false: ask again from the time of the last sample"),
        },
        {
            "samples": _list("Sample"),
            "buckets": _list("Bucket", "Instead of samples, if `bucket` was asked for"),
        },
    ),
    "Bucket": _record(
        {
            "time": _about(TEXT, "Its beginning, a multiple of its length"),
            "quality": _about(
                choice("good", "partial", "bad"),
                "partial: there was a gap; bad: no valid value, all values are null",
            ),
            "good": _about(INTEGER, "Good samples"),
            "bad": _about(INTEGER, "Bad samples"),
            "known": _about(NUMBER, "Seconds with a valid value"),
        },
        {
            **dict.fromkeys(("min", "max"), _either(*_SCALAR, "null")),
            "mean": _about(_NUMBER_OR_NULL, "Weighted by time"),
            "last": _either(*_SCALAR, "array", "null"),
            "reason": _about(_TEXT_OR_NULL, "Of the last gap"),
            "origin": _ORIGIN,
        },
    ),
    "Written": _record(
        {
            "value": _VALUE,
            "time": TEXT,
            "verified": _about(FLAG, "Read back and found equal"),
            "acknowledged": _about(FLAG, "false only for a broadcast"),
            "took": NUMBER,
        },
        {
            "note": _about(TEXT, "What the client must know, such as a possible race"),
            "origin": _ORIGIN,
        },
    ),
    "WrittenGroup": _record(
        {"tags": _by_name(ref("Written"), "By tag, in their order"), "took": NUMBER}
    ),
    "Alarms": _record({"alarms": _list("Alarm"), "counts": _by_name(INTEGER), "next": _NEXT}),
    "Alarm": _record(
        {
            "alarm": _about(TEXT, "device/tag, device, or line:name"),
            "state": choice("normal", "active", "acknowledged", "returned"),
            "level": choice(*(level.value for level in Level), None),
            "limit": _either("number", "boolean", "null"),
            "value": _about(ANY, "The present value"),
            "quality": _QUALITY,
            "value_at_change": _about(ANY, "The value when the state or level began"),
            "unit": TEXT,
            **dict.fromkeys(("since", "raised"), _TEXT_OR_NULL),
            "acknowledged": {
                **_record({"by": TEXT, "time": TEXT, "via": _TEXT_OR_NULL}, more=True),
                "type": ["object", "null"],
            },
            "text": TEXT,
        },
        {**_SAMPLE_MORE, "time": TEXT},
    ),
    "Acknowledgement": _record(
        {"by": _about({"type": "string", "maxLength": 100}, "Name of the operator")},
        {
            "raised": _about(
                TEXT, "`raised` of the alarm that the operator saw: it was raised again, 409"
            )
        },
    ),
}
