"""The records of the audit: lines of JSON, each with the hash of the one before.

A record that is changed, moved or taken out breaks the chain. The end can be cut off unseen:
compare its hash with the one in the log.
"""

import hashlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

import orjson

from gateway.tags.timestamps import rfc3339


class Link(NamedTuple):
    """A record as the next one needs it: its number and its hash."""

    number: int = 0
    hash: str = ""


class Event(NamedTuple):
    """An outcome or an acknowledgement, as JSON. `time`: ns since 1970."""

    time: int
    text: str


class Checked(NamedTuple):
    """A record that was read. `why`: the chain is broken here; empty: it is sound."""

    number: int
    time: str
    event: Any
    why: str


def lines(last: Link, events: Iterable[Event]) -> tuple[bytes, Link]:
    """Returns the lines of new records after the last one, and their last."""
    written = []
    for event in events:
        record = {
            "n": last.number + 1,
            "time": rfc3339(event.time),
            "before": last.hash,
            "event": orjson.loads(event.text),
        }
        line = orjson.dumps(record)
        last = Link(last.number + 1, _hash(line))
        written.append(line + b"\n")
    return b"".join(written), last


def link(line: bytes) -> Link:
    """Returns the link to a line, whatever is in it."""
    number = 0
    with suppress(ValueError, TypeError, KeyError):
        number = int(orjson.loads(line)["n"])
    return Link(number, _hash(line))


def checked(found: Iterable[bytes]) -> Iterator[Checked]:
    """Yields the records of lines, the oldest first. The first record that is kept has none before
    it to compare."""
    last: Link | None = None
    for line in found:
        number, time, event, why = 0, "", None, ""
        try:
            record = orjson.loads(line)
            number, time, event = int(record["n"]), str(record["time"]), record["event"]
            if last is not None and record["before"] != last.hash:
                why = f"record {number} does not follow record {last.number} as it is now"
            elif last is not None and number != last.number + 1:
                why = f"record {number} follows record {last.number}"
        except (ValueError, TypeError, KeyError):
            why = f"a line after record {0 if last is None else last.number} is no record"
        last = Link(number, _hash(line))
        yield Checked(number, time, event, why)


def _hash(line: bytes) -> str:
    return hashlib.sha256(line).hexdigest()
