"""The values that clients write and a master reads, as text for a file across restarts."""

import json
from collections.abc import Iterable, Mapping

from gateway.tags import Tag
from gateway.values import Value

FORMAT = 1


def to_text(values: Mapping[Tag, Value]) -> bytes:
    """Returns the content of the file."""
    return json.dumps(
        {"form": FORMAT, "held": {tag.key: value for tag, value in values.items()}}, indent=2
    ).encode()


def from_text(text: bytes, tags: Iterable[Tag]) -> dict[Tag, Value]:
    """Returns the values of the tags that still exist. Raises `ValueError` for a damaged file."""
    match json.loads(text):
        case {"form": 1, "held": dict(held)}:
            known = {tag: held[tag.key] for tag in tags if tag.key in held}
            return {tag: value for tag, value in known.items() if _is_value(value)}
    raise ValueError("no file of held values")


def _is_value(value: object) -> bool:
    return isinstance(value, (bool, int, float, str))
