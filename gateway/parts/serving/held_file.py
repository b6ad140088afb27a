"""The content of the file of held values with `retain: true`."""

import json
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from gateway.tags import Tag
from gateway.values import Value

FORMAT = 1
_SCALARS = (bool, int, float, str)


def to_text(values: Mapping[Tag, Value]) -> bytes:
    """Returns the content of the file."""
    held = {tag.key: value for tag, value in values.items()}
    return json.dumps({"form": FORMAT, "held": held}, indent=2).encode()


def parser(tags: Iterable[Tag]) -> Callable[[Any], dict[Tag, Value]]:
    """Returns the parser of the file: it finds the values of the tags that still exist."""

    def parse(document: Any) -> dict[Tag, Value]:
        if document["form"] != FORMAT:
            raise ValueError("no file of held values")
        held = document["held"]
        known = {tag: _value(held[tag.key]) for tag in tags if tag.key in held}
        return {tag: value for tag, value in known.items() if value is not None}

    return parse


def _value(value: object) -> Value | None:
    if isinstance(value, list) and all(isinstance(one, _SCALARS) for one in value):
        return tuple(value)
    return value if isinstance(value, _SCALARS) else None
