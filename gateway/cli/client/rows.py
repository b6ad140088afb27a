"""Rows to print, made of replies."""

import time
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import orjson
import zenoh

from gateway.cli.client.arguments import parse_value
from gateway.cli.terminal import printable
from gateway.values import Value

if TYPE_CHECKING:
    from gateway.tags import Tag


class TagRow(NamedTuple):
    """A sample to print: `document` is the decoded payload."""

    tag: str  # device/name
    document: dict[str, object]


def without_gateway(tag: str) -> TagRow:
    """Returns the row of a tag after its gateway was lost."""
    from gateway.tags.timestamps import rfc3339  # with all about tags

    now = rfc3339(time.time_ns())
    return TagRow(tag, {"value": None, "quality": "bad", "reason": "no-gateway", "time": now})


def raw(tag: "Tag", sample: zenoh.Sample, about: bytes) -> dict[str, object]:
    """Returns the document of a tag with `payload: raw` in the form of the other tags."""
    value: Value | None = None
    if sample.kind == zenoh.SampleKind.PUT:
        text = sample.payload.to_bytes().decode("utf-8", "replace")
        value = text if tag.layout.type.is_text else parse_value(text)
    return {"value": value, **document(about)}


def document(data: bytes) -> dict[str, object]:
    """Raises `orjson.JSONDecodeError`."""
    found = orjson.loads(data)
    return found if isinstance(found, dict) else {"value": found}


def reason(data: bytes) -> str:
    """Returns the reason in an error reply, printable."""
    if data == b"Timeout":  # Zenoh's own
        return "not all values have arrived in time: is the link slower than 64 kbit/s?"
    with suppress(orjson.JSONDecodeError):
        return printable(str(document(data).get("reason", data.decode("utf-8", "replace"))))
    return printable(data.decode("utf-8", "replace"))
