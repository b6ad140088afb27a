"""The text of wire logs: recordings, fixtures of tests, and logs of other programs.

`1763640000.123456 > 02 30 31` was sent, `<` received. The time is in seconds; the name of the line
may stand in its place, and a journal's prefix before it. `1763640000.2 = mixer/speed 12.5` is a
value that the gateway decoded. All other lines of text are notes.
"""

import json
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

from gateway.values import Value

_PIECE = re.compile(
    r"(?:^|\s)(?:(?P<at>\d+\.\d+)|(?P<line>[^\s<>]+)) (?P<way>[<>]) "
    r"(?P<data>[0-9a-f]{2}(?: [0-9a-f]{2})*)$"
)
_VALUE = re.compile(r"(\d+\.\d+) = (\S+) (.+)$")


class LoggedPiece(NamedTuple):
    """Bytes that were sent (`>`) or received (`<`) together."""

    at: float | None  # seconds since 1970, or since any moment; None: not known
    way: str
    data: bytes


class LoggedValue(NamedTuple):
    """A value that the gateway decoded from the pieces before. None: it was no number."""

    at: float
    tag: str  # device/tag
    value: Value | None


def entries(lines: Iterable[str], line: str | None = None) -> Iterator[LoggedPiece | LoggedValue]:
    """Yields what a wire log holds of one line of the plant; skips the notes.

    `line`: its name; pieces of other lines are skipped. A piece without a name belongs to every
    line.
    """
    for text in lines:
        text = text.rstrip()
        if (match := _PIECE.search(text)) is not None:
            if line is None or match["line"] in (line, None):
                at = None if match["at"] is None else float(match["at"])
                yield LoggedPiece(at, match["way"], bytes.fromhex(match["data"]))
        elif (found := _VALUE.match(text)) is not None:
            with suppress(ValueError):  # no JSON: another note
                value = json.loads(found[3])
                value = tuple(value) if isinstance(value, list) else value
                yield LoggedValue(float(found[1]), found[2], value)


def event_lines(event: dict[str, Any]) -> str:
    """Returns the lines of a wire log for one event of a trace."""
    at = event["time"]
    if "way" in event:
        return f"{at:.6f} {event['way']} {event['bytes']}\n"
    ended, took = at + event["took"], event["took"] * 1000
    note = f"{ended:.6f} # {event['device']}: {event['what']}, {took:.1f} ms"
    if event["failed"]:
        return f"{note}: {json.dumps(event['result'])}\n"
    values = (
        f"{ended:.6f} = {tag} {json.dumps(value, ensure_ascii=False)}\n"
        for tag, value in event["values"].items()
    )
    return f"{note}\n{''.join(values)}"
