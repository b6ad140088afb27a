"""A store of the archive: rows, and the cursor of each gateway beside them.

A store keeps rows and cursor in one step: after a crash at any moment it has both or none of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Protocol

import orjson

from gateway.archive.rows import Row
from gateway.errors import GatewayError

MOST_GAPS = 50  # of one gateway, the last


class StoreDown(GatewayError):
    """The store does not take rows now. Nothing, or everything, was stored."""


class Overtaken(GatewayError):
    """Another archiver has stored rows of this gateway meanwhile. Nothing was stored."""

    def __init__(self, gateway: str) -> None:
        super().__init__(f"another archiver stores {gateway} here")


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples that the store will not get. Times are RFC 3339: of the samples before and after."""

    begin: str | None
    end: str | None
    why: str


@dataclass(frozen=True, slots=True)
class Cursor:
    """The progress of one gateway. Times are microseconds since 1970."""

    gateway: str  # its key: plant/@gateway/demo
    after: str = ""  # the place of the last sample, as the gateway has named it
    samples: int = 0  # in the store
    newest: int = 0  # time of the newest sample
    whole: int = 0  # when the store had everything that was recorded, by this machine's clock
    # The samples may be in the store already: the file of the gateway is another one.
    overlaps: bool = True
    gaps: tuple[Gap, ...] = ()

    def with_gap(self, gap: Gap) -> "Cursor":
        return replace(self, gaps=(*self.gaps, gap)[-MOST_GAPS:])

    def with_rows(self, rows: Sequence[Row], stored: int) -> "Cursor":
        times = (row.time for row in rows)
        latest = max(times, default=0)
        return replace(self, samples=self.samples + stored, newest=max(self.newest, latest))

    def to_json(self) -> str:
        return orjson.dumps(asdict(self)).decode()


def cursor_of(text: str | bytes) -> Cursor:
    """Reads a stored cursor. Raises `StoreDown` for what no archiver has written."""
    try:
        found = orjson.loads(text)
        gaps = tuple(Gap(**gap) for gap in found.pop("gaps"))
        return Cursor(**found, gaps=gaps)
    except (ValueError, TypeError, KeyError, AttributeError):
        raise StoreDown(f"this cursor is damaged: {text[:200]!r}") from None


class Store(Protocol):
    """Every method blocks, and is called by one thread. Raises `StoreDown`."""

    every: float  # seconds between two looks at a gateway that has nothing new

    def cursors(self) -> Mapping[str, Cursor]:
        """Opens the store if need be. Returns the cursors by the gateways' keys."""
        ...

    def add(self, rows: Sequence[Row], before: Cursor, after: Cursor) -> Cursor:
        """Stores rows and cursor. Returns the cursor with the number of stored rows added.

        Leaves out rows that are there already, if the cursor `overlaps`. Raises `Overtaken` if the
        store has another cursor than `before`.
        """
        ...

    def close(self) -> None: ...
