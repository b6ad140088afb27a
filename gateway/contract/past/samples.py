"""The samples that a query of the past asks for, for Zenoh and HTTP alike."""

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import TypeVar

from gateway.contract.interfaces import History
from gateway.contract.past.history_query import HistoryQuery
from gateway.errors import Damaged
from gateway.tags import Sample, Tag
from gateway.tags.sample import has_value

T = TypeVar("T")


def samples(
    history: History,
    tag: Tag,
    asked: HistoryQuery,
    limit: int | None,
    now: int,
    pause: Callable[[], None],
) -> Iterator[Sample]:
    """Yields the newest samples, or the first `limit`. Raises as `History.samples`."""
    if asked.last is not None:
        return history.newest(tag, asked, now, pause)
    if not asked.only_good:
        return history.samples(tag, asked.time_range, limit, now)
    found = history.samples(tag, asked.time_range, None, now)
    return islice(filter(has_value, found), limit)


def one_by_one(answers: Iterable[Iterator[T]]) -> Iterator[T]:
    """Yields all of each answer; raises `Damaged` at the end, if one did."""
    lost: Damaged | None = None
    for answer in answers:
        try:
            yield from answer
        except Damaged as error:
            lost = error
    if lost is not None:
        raise lost
