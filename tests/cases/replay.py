"""Reads wire logs, so that a recording from a plant becomes a test: docs/wire-log-to-test.md."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# `hall-1 > 02 30` as the gateway logs it, or `12.345678 > 02 30`; a journal's prefix may precede.
PIECE = re.compile(
    r"(?:^|\s)(?:\d+\.\d+|(?P<line>[^\s<>]+)) (?P<way>[<>]) (?P<data>[0-9a-f]{2}(?: [0-9a-f]{2})*)$"
)


class Piece(NamedTuple):
    """The bytes of one line of a wire log: sent (`>`) or received (`<`)."""

    way: str
    data: str  # hexadecimal, with spaces


Transaction = list[str]  # a `tests.doubles.Script`: one request and the bytes that followed it


def pieces(log: Path, line: str | None = None) -> Iterator[Piece]:
    """The pieces of one line of the plant in their order; other lines of text are skipped.

    `line`: the name of the line; pieces of other lines are skipped. A piece without a name belongs
    to every line.
    """
    for text in log.read_text("utf-8").splitlines():
        match = PIECE.search(text.rstrip())
        if match and (line is None or match["line"] in (line, None)):
            yield Piece(match["way"], match["data"])


def transactions(log: Path, line: str | None = None) -> list[Transaction]:
    """Every request with the pieces that were received before the next request."""
    found: list[Transaction] = []
    for way, data in pieces(log, line):
        if way == ">":
            found.append([])
        if found:  # bytes before the first request belong to no transaction
            found[-1].append(f"{way} {data}")
    return found
