"""Recorded samples as rows of a store.

Every store has the same columns, whatever the type of a tag is and becomes:

* Numbers and bits (0, 1) are in `value`, texts and the names of an `enum` in `text`, arrays in
  `elements`. Beyond 2^53 a number is exact in `text` only, and an array too, as JSON.
* `reason` is empty for a good sample. A bad one has no value; an uncertain one has both.
* `origin` is empty for the plain reading of a device: `simulated`, `held`, `computed` ...
"""

from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import orjson

from gateway.bridges.documents import Known
from gateway.tags import timestamps

_EPOCH, _MICROSECOND = datetime(1970, 1, 1, tzinfo=UTC), timedelta(microseconds=1)
_EXACT = 2**53


class Row(NamedTuple):
    """One sample. `time`: microseconds since 1970; `key`: with the prefix."""

    time: int
    key: str
    value: float | None
    text: str | None
    elements: tuple[float, ...] | None
    reason: str | None
    origin: str | None
    limited: str | None

    @property
    def quality(self) -> str:
        if self.reason is None:
            return "good"
        has_value = (self.value, self.text, self.elements) != (None, None, None)
        return "uncertain" if has_value else "bad"

    def document(self) -> Known:
        """Returns the sample as a gateway publishes it."""
        known: Known = {"quality": self.quality, "time": rfc3339(self.time)}
        if self.elements is not None:
            known["value"] = list(self.elements)
        else:
            known["value"] = self.text if self.value is None else self.value
            if self.value is not None and self.text is not None:
                known["text"] = self.text
        named = (("reason", self.reason), ("origin", self.origin), ("limited", self.limited))
        return known | {name: word for name, word in named if word is not None}


def row_of(key: str, known: Known) -> Row:
    """Returns the row of a checked document."""
    value, text = known["value"], known.get("text")
    elements: tuple[float, ...] | None = None
    if isinstance(value, list):
        if any(_is_large(one) for one in value):
            text = orjson.dumps(value).decode()
        elements, value = tuple(map(float, value)), None
    elif isinstance(value, str):
        value, text = None, value
    elif _is_large(value):
        text = str(value)
    return Row(
        (datetime.fromisoformat(known["time"]) - _EPOCH) // _MICROSECOND,
        key,
        None if value is None else float(value),
        _clean(text),
        elements,
        None if known["quality"] == "good" else _clean(known["reason"]),
        _clean(known.get("origin")),
        _clean(known.get("limited")),
    )


def _clean(text: str | None) -> str | None:
    """No database takes a NUL."""
    return None if text is None else text.replace("\0", "\ufffd")


def _is_large(value: object) -> bool:
    return isinstance(value, int) and abs(value) > _EXACT


def rfc3339(time: int) -> str:
    """Returns microseconds since 1970 as text."""
    return timestamps.rfc3339(time * 1000)
