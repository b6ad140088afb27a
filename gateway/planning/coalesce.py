"""Covers items by the requests with the least wire time per second: an exact search.

The items lie in a row by address; each has an interval. A request reads a run of neighbouring
items at one interval. An item may join a request that is sent more often than the item needs, and
requests of different intervals may overlap.

The search walks the row from left to right. A state holds, for each interval, the item where its
open request began, if one is open. Two rules drop states that cannot become the best: a state
that costs more than the cheapest one plus new requests in place of its open ones; and a state
that costs no less than another one and has less room left in its open requests. On a serial wire
fewer than a hundred states remain. On a network, where characters cost almost nothing, many
intervals leave more: there the search follows only the cheapest `MOST`. Its result may then cost
more than the least; no such case has been seen.
"""

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

# Seconds of one transaction over items first..last; None where one request cannot hold them.
SecondsOf = Callable[[int, int], float | None]
CLOSED = -1
MOST = 200  # states kept at each item
_TINY = 1e-12


class Request(NamedTuple):
    """Items `first` to `last`, read together every `every` seconds."""

    first: int
    last: int
    every: float


# A linked list of the closed requests, newest first: first item, last item, interval, the next.
_Closed = tuple[int, int, float, Any]
_Starts = tuple[int, ...]  # for each interval, fastest first: first item of its open request
# A cover of the items so far: its wire time per second, as if the open requests ended here; the
# open requests; the closed requests.
_State = tuple[float, _Starts, _Closed | None]


def coalesce(
    intervals: Sequence[float],
    seconds: SecondsOf,
    splits: frozenset[int] = frozenset(),
    *,
    even: bool = False,
) -> list[Request]:
    """Returns the requests of least wire time for items with these intervals (seconds), by address.

    No request crosses the border before an item in `splits`. `seconds` must not fall when a request
    grows. `even` promises that one more item adds the same to a request wherever that request
    began: true for registers, not for bits, which are packed from the first one. It makes long
    rows much faster. Raises `ValueError` with the index of an item that fits no request.
    """
    rates = sorted(set(intervals))
    rank = {every: rate for rate, every in enumerate(rates)}
    states: list[_State] = [(0.0, (CLOSED,) * len(rates), None)]
    for item, interval in enumerate(intervals):
        alone = seconds(item, item)
        if alone is None:
            raise ValueError(item)
        fresh = [alone / every for every in rates]
        growth = _growth(item, states, seconds, split=item in splits, even=even)
        found = _step(states, item, rank[interval], rates, fresh, growth)
        states = (_undominated if even else _contenders)(found, fresh)
    _, starts, done = min(states, key=_total)
    return _requests(starts, done, len(intervals) - 1, rates)


def _growth(
    item: int, states: Sequence[_State], seconds: SecondsOf, *, split: bool, even: bool
) -> dict[int, float | None]:
    """Returns the seconds `item` adds to an open request, by its first item; None: does not fit."""
    begins = sorted({start for _, starts, _ in states for start in starts if start != CLOSED})
    if split:
        return dict.fromkeys(begins)
    growth: dict[int, float | None] = {}
    for place, start in enumerate(begins):
        whole = seconds(start, item)
        if whole is None:
            growth[start] = None
            continue
        more = whole - (seconds(start, item - 1) or 0.0)
        if even:  # requests that began later are shorter, so the item fits them too
            growth.update(dict.fromkeys(begins[place:], more))
            break
        growth[start] = more
    return growth


def _step(
    states: Sequence[_State],
    item: int,
    rank: int,
    rates: Sequence[float],
    fresh: Sequence[float],
    growth: dict[int, float | None],
) -> list[_State]:
    """Returns the states after `item`: each open request continues or ends, and others begin.

    `rank` is the place of the item's interval in `rates`; `fresh` the cost of a new request for
    the item alone, by interval. Only the fastest open request may end although it could continue:
    it alone read the item before. The others were of no use there and would have ended earlier.
    """
    found: dict[_Starts, _State] = {}
    for total, starts, done in states:
        fastest, saved = CLOSED, 0.0
        for rate, start in enumerate(starts):
            if start == CLOSED:
                continue
            more = growth[start]
            if more is None:
                starts, done = _end(starts, done, rate, item, rates)
                if fastest == CLOSED:
                    fastest = len(rates)  # it has ended already
                continue
            more /= rates[rate]
            total += more
            if fastest == CLOSED:
                fastest, saved = rate, more
        _read(found, total, starts, done, item, rank, fresh)
        if CLOSED < fastest < len(rates):
            starts, done = _end(starts, done, fastest, item, rates)
            _read(found, total - saved, starts, done, item, rank, fresh)
    return list(found.values())


def _end(
    starts: _Starts, done: _Closed | None, rate: int, item: int, rates: Sequence[float]
) -> tuple[_Starts, _Closed | None]:
    closed = (starts[rate], item - 1, rates[rate], done)
    return (*starts[:rate], CLOSED, *starts[rate + 1 :]), closed


def _read(
    found: dict[_Starts, _State],
    total: float,
    starts: _Starts,
    done: _Closed | None,
    item: int,
    rank: int,
    fresh: Sequence[float],
) -> None:
    """Adds the states that read the item. A request begins only if no open one reads it."""
    for start in starts[: rank + 1]:
        if start != CLOSED:
            known = found.get(starts)
            if known is None or total < known[0] - _TINY:
                found[starts] = (total, starts, done)
            return
    for rate in range(rank + 1):
        began = (*starts[:rate], item, *starts[rate + 1 :])
        cost = total + fresh[rate]
        known = found.get(began)
        if known is None or cost < known[0] - _TINY:
            found[began] = (cost, began, done)


_total: Callable[[_State], float] = itemgetter(0)


def _contenders(states: list[_State], fresh: Sequence[float]) -> list[_State]:
    """Drops states that cannot become the best.

    The cheapest state can continue like any other one after it begins that one's open requests
    again, each at the cost of one transaction over a single item at most.
    """
    best = min(map(_total, states))

    def could_win(state: _State) -> bool:
        prices = zip(state[1], fresh, strict=True)
        most = best + sum(price for start, price in prices if start != CLOSED)
        return state[0] < most - _TINY or state[0] <= best + _TINY

    return [state for state in states if could_win(state)]


def _undominated(states: list[_State], fresh: Sequence[float]) -> list[_State]:
    """Drops states that a cheaper one can replace by new requests only where it has less room.

    Planning spends most of its time here, hence the flat loops. `strict` would add a third to the
    whole; the three sequences have one entry for each interval.
    """
    kept: list[_State] = []
    everything = sum(fresh) + _TINY
    for state in sorted(states, key=_total):
        limit, wanted = state[0] + _TINY, state[1]
        for total, starts, _ in kept:
            left = limit - total
            if left > everything:
                break
            for start, want, price in zip(starts, wanted, fresh):  # noqa: B905  (see above)
                if want > start:  # CLOSED is below every start
                    left -= price
                    if left < 0:
                        break
            else:
                break  # a cheaper state replaces this one
        else:
            kept.append(state)
            if len(kept) == MOST:
                break
    return kept


def _requests(
    starts: _Starts, done: _Closed | None, last: int, rates: Sequence[float]
) -> list[Request]:
    found = [
        Request(start, last, every)
        for start, every in zip(starts, rates, strict=True)
        if start != CLOSED
    ]
    while done is not None:
        first, end, every, done = done
        found.append(Request(first, end, every))
    return sorted(found)
