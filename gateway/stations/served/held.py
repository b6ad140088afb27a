"""The values that clients write and a master reads, as text for a file across restarts."""

import json
from collections.abc import Iterable, Mapping

from gateway.tags import Tag
from gateway.values import Value

FORMAT = 1
_SCALARS = (bool, int, float, str)


def to_text(values: Mapping[Tag, Value]) -> bytes:
    """Returns the content of the file."""
    return json.dumps(
        {"form": FORMAT, "held": {tag.key: value for tag, value in values.items()}}, indent=2
    ).encode()


def from_text(text: bytes, tags: Iterable[Tag]) -> dict[Tag, Value]:
    """Returns the values of the tags that still exist. Raises `ValueError` for a damaged file."""
    match json.loads(text):
        case {"form": 1, "held": dict(held)}:
            known = {tag: _value(held[tag.key]) for tag in tags if tag.key in held}
            return {tag: value for tag, value in known.items() if value is not None}
    raise ValueError("no file of held values")


def _value(value: object) -> Value | None:
    if isinstance(value, list) and all(isinstance(one, _SCALARS) for one in value):
        return tuple(value)
    return value if isinstance(value, _SCALARS) else None
