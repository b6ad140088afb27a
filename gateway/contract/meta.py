"""The description of a tag for clients: `@meta`, the JSON API, and the sheet of `export`."""

import orjson

from gateway.tags import Tag
from gateway.tags.shaping import PLAIN, Bounds
from gateway.tags.tag import CounterRule


def meta(tag: Tag) -> bytes:
    """The description of a tag: type, address, unit, interval, limits."""
    return orjson.dumps(meta_fields(tag))


def meta_fields(tag: Tag) -> dict[str, object]:
    rule, deadband, shaping = tag.write, tag.publishing.deadband, tag.shaping or PLAIN
    low, high = shaping.clamp or Bounds()
    return {
        "type": tag.value_type,
        "raw_type": str((tag if tag.origin.kept is None else tag.origin.inputs[0]).layout.type),
        "length": tag.layout.type.count or None,
        "address": tag.text,
        "unit": tag.label.unit,
        "description": tag.label.description,
        "every": tag.every,
        "scale": tag.shaping.scale,
        "offset": tag.shaping.offset,
        "from": None if shaping.ends is None else shaping.ends.raw,
        "to": None if shaping.ends is None else shaping.ends.value,
        "decimals": shaping.decimals,
        "clamp": None if shaping.clamp is None else {"min": low, "max": high},
        "invert": shaping.invert,
        "debounce": tag.origin.kept if isinstance(tag.origin.kept, float) else None,
        "counter": tag.origin.kept._asdict() if isinstance(tag.origin.kept, CounterRule) else None,
        "computed": None if tag.origin.formula is None else tag.origin.formula.text,
        "enum": None
        if tag.shaping.names is None
        else {str(number): name for number, name in tag.shaping.names.by_number.items()},
        "publish": tag.publishing.publish.value,
        "deadband": None
        if deadband is None
        else {"amount": deadband.amount, "percent": deadband.percent},
        "heartbeat": tag.publishing.heartbeat,
        "history": tag.publishing.history,
        "payload": tag.publishing.payload.value,
        "event": tag.publishing.event,
        "write": None
        if rule is None
        else {"min": rule.min, "max": rule.max, "verify": rule.verify},
    }
