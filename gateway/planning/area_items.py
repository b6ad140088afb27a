"""Covers rows of addresses by requests, equal rows only once.

Large plants have many devices of one model with the same tags, or with the same tags at other
addresses. Words cost the same at every address, so their rows are compared from the first one on.
Bits are packed by address: their rows are equal at equal addresses only.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

from gateway.planning.coalesce import Request, coalesce
from gateway.protocols.driver import Cost, Span, Unit
from gateway.protocols.models import Model

LONG_ROW = 300  # items of one area
LONGEST_KEPT = 500  # items of a row whose requests are remembered; of longer rows, of the last few
LONGEST = 10_000
Seconds = Callable[[Cost], float]  # of a transaction; equal ones give equal results


class AreaItems(NamedTuple):
    """The items of one area, by address. `ends` are exclusive; `every` in seconds."""

    area: str
    starts: tuple[int, ...]
    ends: tuple[int, ...]
    every: tuple[float, ...]
    splits: frozenset[int]  # items before which a request must end


def requests_of(row: AreaItems, model: Model, seconds: Seconds) -> Sequence[Request]:
    """Returns the requests of least wire time for the row.

    Raises `ValueError` with the index of an item that fits no request.
    """
    if len(row.starts) > LONGEST:
        return cover(row, model, seconds)
    if _of_words(row, model):
        by = model.driver.areas[row.area].first - row.starts[0]
        starts = tuple([start + by for start in row.starts])
        row = row._replace(starts=starts, ends=tuple([end + by for end in row.ends]))
    remembered = _remembered if len(row.starts) <= LONGEST_KEPT else _last_few
    return remembered(row, model, seconds)


def cover(row: AreaItems, model: Model, seconds: Seconds) -> tuple[Request, ...]:
    """As `requests_of`, always calculated."""
    area, starts, ends, every, splits = row
    driver = model.driver
    # None: the cost depends on the address too.
    by_size = _words(area, model, seconds) if _of_words(row, model) else None

    def transaction(first: int, last: int) -> float | None:
        start = starts[first]
        size = ends[last] - start
        if by_size is not None and size in by_size:
            return by_size[size]
        cost = driver.cost(Span(area, start, size))
        found = None if cost is None else seconds(cost)
        if by_size is not None:
            by_size[size] = found
        return found

    # Bits are packed and so not even. For a very long row speed counts more: there a request may
    # cost one character more than the least.
    even = driver.areas[area].unit is not Unit.BIT or len(starts) > LONG_ROW
    return tuple(coalesce(every, transaction, splits, even=even))


def _of_words(row: AreaItems, model: Model) -> bool:
    """Returns True for words inside their area: the cost of a read depends on its size alone."""
    area = model.driver.areas[row.area]
    inside = area.first <= row.starts[0] and row.ends[-1] <= area.last + 1
    return inside and area.unit is not Unit.BIT


_remembered = lru_cache(maxsize=1024)(cover)
_last_few = lru_cache(maxsize=4)(cover)


@lru_cache(maxsize=64)
def _words(area: str, model: Model, seconds: Seconds) -> dict[int, float | None]:
    """Returns the seconds of reads of words by their number, as far as they are known."""
    return {}
