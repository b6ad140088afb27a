"""Answers in pages: `?page=1000`, and the rest with `?page=1000;after=<next of the last page>`.

The last reply to each page is a document on `<prefix>/@gateway/<name>/page`. It has the number of
samples, so that the client knows that it has all of them. Several gateways answer one query, each
with its own document: `after` then has the `next` of each, with commas between them.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import orjson
import zenoh

from gateway.contract.documents.values import PageDocument
from gateway.errors import BadValue, Damaged
from gateway.tags import Tag
from gateway.tags.recorded import Place

LARGEST = 100_000  # replies
_BATCH = 16_384  # bytes of a reply with many samples: what waits behind it on a link waits shortly


class Page(NamedTuple):
    """At most `size` replies, from after the place `after` of this gateway."""

    size: int
    after: str | None


class Batches:
    """Collects samples for replies of many: one reply for each takes ten times as long."""

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send, self._keys, self._values, self._size = send, list[str](), list[bytes](), 0

    def add(self, key: str, value: bytes) -> None:
        self._keys.append(key)
        self._values.append(value)
        self._size += len(key) + len(value)
        if self._size >= _BATCH:
            self.end()

    def end(self) -> None:
        if self._keys:
            keys, values = orjson.dumps(self._keys), b",".join(self._values)
            self._send(b'{"keys":%b,"values":[%b]}' % (keys, values))
        self._keys, self._values, self._size = [], [], 0


def is_paged(query: zenoh.Query) -> bool:
    return query.parameters.get("page") is not None


def page(query: zenoh.Query, gateway: str) -> Page | None:
    """Returns the page that a query asks for, None if it asks for all. Raises `BadValue`."""
    size = query.parameters.get("page")
    if size is None:
        return None
    if not (size.isascii() and size.isdigit() and len(size) < 9 and 1 <= int(size) <= LARGEST):
        raise BadValue(f"page={size[:40]} is no count from 1 to {LARGEST}")
    if query.accepts_replies() != zenoh.ReplyKeyExpr.ANY:
        raise BadValue("a query with page needs accept_replies=ANY: its last reply has another key")
    places = dict(
        place.partition(":")[::2] for place in (query.parameters.get("after") or "").split(",")
    )
    return Page(int(size), places.get(gateway))


def recorded_place(after: str | None) -> Place | None:
    """Parses the place of a recorded sample. Raises `BadValue`."""
    match (after or "").split("-"):
        case [""]:
            return None
        case [file, run, n] if run.isdecimal() and n.isdecimal() and len(run + n) < 30:
            return file, int(run), int(n)
    raise BadValue(f"after={after!r:.60}: this is no `next` of an earlier page")


def rest(tags: Sequence[Tag], after: str | None) -> Sequence[Tag]:
    """Returns the tags after the tag of this key. Raises `BadValue` if it is not among them."""
    if after is None:
        return tags
    for number, tag in enumerate(tags):
        if tag.key == after:
            return tags[number + 1 :]
    raise BadValue(f"after={after[:60]}: the tags are others now. Begin with the first page")


def end(
    gateway: str,
    count: int,
    last: str | Place,
    *,
    complete: bool,
    again: int,
    lost: Damaged | None,
) -> bytes:
    """Returns the last document of a page; `last`: the tag or the place of its last reply."""
    place = last if isinstance(last, str) else "-".join(map(str, last))
    document: PageDocument = {
        "samples": count,
        "complete": complete,
        "next": f"{gateway}:{place}",
    }
    if again:
        document["again"] = again
    if lost is not None:
        document["damaged"] = str(lost)
    return orjson.dumps(document)
