"""Reads wire logs, so that a recording from a plant becomes a test.

docs/contributors/wire-log-to-test.md explains the method.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gateway.parts.recording.wire_file import LoggedPiece, entries


class Piece(NamedTuple):
    """The bytes of one line of a wire log: sent (`>`) or received (`<`)."""

    way: str
    data: str  # hexadecimal, with spaces


Transaction = list[str]  # a `tests.doubles.Script`: one request and the bytes that followed it


def pieces(log: Path, line: str | None = None) -> Iterator[Piece]:
    """The pieces of one line of the plant in their order; other lines of text are skipped."""
    for entry in entries(log.read_text("utf-8").splitlines(), line):
        if isinstance(entry, LoggedPiece):
            yield Piece(entry.way, entry.data.hex(" "))


def transactions(log: Path, line: str | None = None) -> list[Transaction]:
    """Every request with the pieces that were received before the next request."""
    found: list[Transaction] = []
    for way, data in pieces(log, line):
        if way == ">":
            found.append([])
        if found:  # bytes before the first request belong to no transaction
            found[-1].append(f"{way} {data}")
    return found
