"""The cheapest set of requests that reads everything as often as it is wanted, found exactly.

What is to be read lies in a row by address, and each item has its interval. A request covers a
run of items at one interval; an item may be in a request that is asked more often than it
needs, and requests of different intervals may reach over one another. Looked for is the set with
the least wire time per second.

The row is walked from left to right. A state says, for each interval, where its request that
reaches over the current item began, if there is one. Of all states only those are kept that
could still win: whoever is dearer than the cheapest by as much as it costs to begin its
open requests afresh will never be cheaper; nor will one that is no cheaper and has less room
left in its open requests. On a wire fewer than a hundred are left. Where characters cost next
to nothing, as on a network, and intervals are many, only the cheapest `MOST` are followed: then
what is found may not be the least, though none was seen that was dearer.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

# Seconds of one exchange over items first..last, None where one request cannot hold them.
SecondsOf = Callable[[int, int], float | None]
CLOSED = -1
MOST = 200  # states that are followed
_TINY = 1e-12


class Request(NamedTuple):
    """Items `first` .. `last` asked for together every `every` seconds."""

    first: int
    last: int
    every: float


class _Closed(NamedTuple):
    """Requests that have ended, newest first."""

    request: Request
    before: "_Closed | None"


_Starts = tuple[int, ...]  # by interval, fastest first: where the open request began, or CLOSED
# One way to have covered the items so far: its wire time per second, as if the open requests
# were closed here; the open requests; the closed ones.
_State = tuple[float, _Starts, _Closed | None]


def cover(
    intervals: Sequence[float],
    seconds: SecondsOf,
    splits: frozenset[int] = frozenset(),
    *,
    even: bool = False,
) -> list[Request]:
    """The requests of least wire time for items with these intervals (seconds), by address.

    No request reaches over the border before an item in `splits`. Raises `ValueError` when a
    single item fits no request. `seconds` must not fall when a request grows. `even` promises
    that one more item costs a request the same wherever it began (registers do, bits that are
    packed from their first one do not); it makes long rows much faster.
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
        step = _Step(item, rank[interval], rates, fresh, growth)
        found: dict[_Starts, _State] = {}
        for state in states:
            for after in step.after(state):
                known = found.get(after[1])
                if known is None or after[0] < known[0] - _TINY:
                    found[after[1]] = after
        states = (_undominated if even else _contenders)(list(found.values()), fresh)
    _, starts, done = min(states, key=_total)
    return _requests(starts, done, len(intervals) - 1, rates)


def _growth(
    item: int, states: Sequence[_State], seconds: SecondsOf, *, split: bool, even: bool
) -> dict[int, float | None]:
    """What `item` adds to each open request, by where that began; None where it does not fit."""
    begun = sorted({start for _, starts, _ in states for start in starts if start != CLOSED})
    if split:
        return dict.fromkeys(begun)
    growth: dict[int, float | None] = {}
    for place, start in enumerate(begun):
        whole = seconds(start, item)
        if whole is None:
            growth[start] = None
            continue
        more = whole - (seconds(start, item - 1) or 0.0)
        if even:  # those that began later are shorter still
            growth.update(dict.fromkeys(begun[place:], more))
            break
        growth[start] = more
    return growth


class _Step(NamedTuple):
    """What may be done at one item."""

    item: int
    rate: int  # which of the intervals the item wants
    rates: Sequence[float]
    fresh: Sequence[float]  # by interval: what a new request for the item alone costs
    growth: dict[int, float | None]

    def after(self, state: _State) -> Iterator[_State]:
        """Every state that `state` can become: each open request goes on or ends, others begin.

        Of the open requests only the fastest served the item before, so it alone may end without
        need: the others would have ended sooner.
        """
        total, starts, done = state
        fastest: int | None = None
        spared: float | None = None
        for rate, start in enumerate(starts):
            if start == CLOSED:
                continue
            more = self.growth[start]
            if more is None:
                starts, done = self._end(starts, done, rate)
            else:
                more /= self.rates[rate]
                total += more
            if fastest is None:
                fastest, spared = rate, more
        yield from self._serve(total, starts, done)
        if fastest is not None and spared is not None:
            yield from self._serve(total - spared, *self._end(starts, done, fastest))

    def _end(
        self, starts: _Starts, done: _Closed | None, rate: int
    ) -> tuple[_Starts, _Closed | None]:
        request = Request(starts[rate], self.item - 1, self.rates[rate])
        return (*starts[:rate], CLOSED, *starts[rate + 1 :]), _Closed(request, done)

    def _serve(self, total: float, starts: _Starts, done: _Closed | None) -> Iterator[_State]:
        """A request begins only where nothing else serves."""
        if max(starts[: self.rate + 1]) != CLOSED:
            yield total, starts, done
            return
        for rate in range(self.rate + 1):
            began = (*starts[:rate], self.item, *starts[rate + 1 :])
            yield total + self.fresh[rate], began, done


def _total(state: _State) -> float:
    return state[0]


def _contenders(states: list[_State], fresh: Sequence[float]) -> list[_State]:
    """Those that could still win. From the cheapest one can go on as any other would by
    beginning its open requests afresh, for at most one exchange of a single item each."""
    best = min(map(_total, states))

    def could_win(state: _State) -> bool:
        prices = zip(state[1], fresh, strict=True)
        most = best + sum(price for start, price in prices if start != CLOSED)
        return state[0] < most - _TINY or state[0] <= best + _TINY

    return [state for state in states if could_win(state)]


def _undominated(states: list[_State], fresh: Sequence[float]) -> list[_State]:
    """Without those that another can match by beginning afresh only where it has less room.

    Written out flat, without strict (all three have one place an interval): most of the time that
    a plan takes is spent here, and strict alone would add a third to all of it.
    """
    kept: list[_State] = []
    for state in sorted(states, key=_total):
        limit, wanted = state[0] + _TINY, state[1]
        for total, starts, _ in kept:
            left = limit - total
            for start, want, price in zip(starts, wanted, fresh):  # noqa: B905  (see above)
                if want > start:  # CLOSED is below every start
                    left -= price
                    if left < 0:
                        break
            else:
                break  # matched
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
        found.append(done.request)
        done = done.before
    return sorted(found)
