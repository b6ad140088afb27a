"""The description of a tag for clients: `@meta`, the JSON API, and the sheet of `export`."""

import orjson

from gateway.config.tags.registry import FEATURES
from gateway.contract.keys import CONTRACT
from gateway.tags import Tag


def meta(tag: Tag) -> bytes:
    """The description of a tag: type, address, unit, interval, limits."""
    return orjson.dumps(meta_fields(tag))


def meta_fields(tag: Tag) -> dict[str, object]:
    read = tag if tag.origin.kept is None else tag.origin.inputs[0]
    found: dict[str, object] = {
        "contract": CONTRACT,
        "type": tag.value_type,
        "raw_type": str(read.layout.type),
        "length": tag.layout.type.count or None,
        "address": tag.text,
        "every": tag.every,
        "computed": None if tag.origin.formula is None else tag.origin.formula.text,
        "origin": tag.origin.word,
    }
    for feature in FEATURES:
        found |= feature.meta(tag)
    return found
