"""The contract of a station's data: each protocol answers over simulated memory or served tags."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Protocol

from gateway.tags import Tag
from gateway.values import Value

Cell = tuple[str, int]  # area and number
Written = Sequence[tuple[Tag, Value | None]]  # None: the words hold no value of the tag's type
NOTHING: Mapping[Cell, int] = {}


class Why(StrEnum):
    """The cause of a refusal; each protocol has its own code for it."""

    NO_TAG = "no-tag"  # nothing at the address
    NOT_ACCEPTED = "not-accepted"  # a write where the master may not write
    PART = "part-of-a-tag"  # a write of some words of a longer value
    BAD = "bad"  # the value is not known
    ROLE = "role"  # a write by a master whose role may not write


class Denied(Exception):
    """A request that the station refuses; nothing was written."""

    def __init__(self, why: Why) -> None:
        super().__init__(why.value)
        self.why = why


class Rejected(Exception):
    """A request with a mistake, and the code that the protocol has for it."""

    def __init__(self, code: str) -> None:
        super().__init__(code)
        self.code = code


class Store(Protocol):
    """The data of one station, by area and number. Every method raises `Denied`."""

    def read(self, area: str, start: int, count: int) -> list[int]:
        """Returns the units."""

    def read_points(self, area: str, start: int, count: int) -> list[int]:
        """Returns bits that travel together in one byte or word."""

    def write(
        self,
        cells: Sequence[tuple[Cell, int]],
        points: Sequence[tuple[Cell, int]] = (),
        missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        """Writes one request as a whole or not at all. Returns the written tags, by address.

        `points`: bits that travel together. `missing`: the bits of a cell that the request lacks.
        """


class ReadOnly:
    """The data of a station for a master that may write nothing. A `Store`."""

    def __init__(self, store: Store) -> None:
        self.read, self.read_points = store.read, store.read_points

    def write(
        self,
        _cells: Sequence[tuple[Cell, int]],
        _points: Sequence[tuple[Cell, int]] = (),
        _missing: Mapping[Cell, int] = NOTHING,
    ) -> Written:
        raise Denied(Why.ROLE)
