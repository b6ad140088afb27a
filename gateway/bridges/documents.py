"""The documents of values as a bridge gets them from Zenoh, checked before use."""

import sys
import time
from contextlib import suppress
from datetime import datetime
from typing import Any

import orjson
import zenoh

from gateway.tags.timestamps import rfc3339

MOST_ELEMENTS = 65_536  # of an array
_TEXTS = ("reason", "origin", "limited", "text")
_EPOCH = 1970  # at its end: a zone may put its first hours before it
Known = dict[str, Any]  # value, quality, time, and the reason of a bad value: docs/zenoh.md


def utc_now() -> str:
    return rfc3339(time.time_ns())


def bad(reason: str) -> Known:
    return {"value": None, "quality": "bad", "reason": reason, "time": utc_now()}


def described_by(key: str, payload: bytes) -> Known | None:
    """Returns the description of a tag, None for that of another program."""
    with suppress(ValueError):
        meta = orjson.loads(payload)
        if is_name(key) and _is_description(meta):
            plain = {"unit": "", "description": "", "history": False, "write": None}
            found: Known = plain | meta
            return found
    return None


def _is_description(meta: Any) -> bool:
    """Checks what the bridges use of a description. It has more, and may get more."""
    if not isinstance(meta, dict) or not isinstance(meta.get("type"), str):
        return False
    length = meta.get("length")
    return (
        all(isinstance(meta.get(name, ""), str) for name in ("unit", "description"))
        and all(isinstance(meta.get(name, False), bool) for name in ("history", "event"))
        and (length is None or (type(length) is int and 0 < length <= MOST_ELEMENTS))
        and all(_are_limits(meta.get(name)) for name in ("write", "clamp", "range"))
    )


def _are_limits(limits: Any) -> bool:
    if not isinstance(limits, dict):
        return limits is None
    return all(limits.get(end) is None or is_number(limits[end]) for end in ("min", "max"))


def is_name(key: str) -> bool:
    """Returns False for a key of another program that no broker and no database takes. Zenoh allows
    every character but its own."""
    return key.isprintable() and "+" not in key


def parsed(meta: Known, is_put: bool, payload: bytes, about: bytes) -> Known:
    """Returns the document of a payload, also of a tag with `payload: raw`. A payload that is none
    is `garbled`."""
    return document_of(meta, is_put, payload, about) or bad("garbled")


def document_of(meta: Known, is_put: bool, payload: bytes, about: bytes) -> Known | None:
    """Returns the document of a payload, None where it is none: it is from another program."""
    try:
        if not about:
            known = orjson.loads(payload)
        else:
            is_text = meta["type"].startswith("string")
            value = payload.decode() if is_text else orjson.loads(payload or b"null")
            known = {"value": value if is_put else None, **orjson.loads(about)}
        return known if is_value(known) else None
    except (KeyError, TypeError, ValueError):
        return None


def is_value(known: Any) -> bool:
    """Checks a document. Raises KeyError, TypeError or ValueError where a field lacks."""
    value, reason = known["value"], known.get("reason")
    time = datetime.fromisoformat(known["time"])
    if time.tzinfo is None or time.year <= _EPOCH:
        return False
    if any(not isinstance(known.get(name, ""), str) for name in _TEXTS):
        return False
    if known["quality"] == "bad":
        return value is None and isinstance(reason, str)
    if known["quality"] != "good" and not (known["quality"] == "uncertain" and reason):
        return False
    if isinstance(value, list):  # of an array
        return all(map(is_number, value))
    return is_number(value) or isinstance(value, str)


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max  # no NaN


def copied(sample: zenoh.Sample) -> tuple[str, bool, bytes, bytes]:
    """Returns key, put or delete, payload, attachment. (A sample keeps the batch it came in.)"""
    about = sample.attachment
    is_put = sample.kind == zenoh.SampleKind.PUT
    return (
        str(sample.key_expr),
        is_put,
        sample.payload.to_bytes(),
        b"" if about is None else about.to_bytes(),
    )
