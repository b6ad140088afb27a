"""The cheapest set of requests that reads everything as often as it is wanted, found exactly.

What is to be read lies in a row by address, and each item has its interval. A request covers a
run of items at one interval; an item may be in a request that is asked more often than it
needs, and requests of different intervals may reach over one another. Looked for is the set with
the least wire time per second.

The row is walked from left to right. A state says, for each interval, where its request that
reaches over the current item began, if there is one. Of all states only those are kept that
could still win: whoever is dearer than the cheapest by as much as it costs to begin its
open requests afresh will never be cheaper; nor will one that is no cheaper and has less room
left in its open requests.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

# Seconds of one exchange over items first..last, None where one request cannot hold them.
SecondsOf = Callable[[int, int], float | None]
CLOSED = -1
_TINY = 1e-12


class Request(NamedTuple):
    """Items `first` .. `last` asked for together every `every` seconds."""

    first: int
    last: int
    every: float


@dataclass(slots=True, eq=False)
class _State:
    """One way to have covered the items so far."""

    starts: tuple[int, ...]  # by interval, fastest first: where the open request began
    paid: float  # wire time per second of the requests that are closed
    total: float  # as if the open ones were closed here
    done: "_Closed | None"  # the closed requests, newest first


@dataclass(slots=True, eq=False)
class _Closed:
    request: Request
    before: "_Closed | None"


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
    states = [_State((CLOSED,) * len(rates), 0.0, 0.0, None)]
    for item, interval in enumerate(intervals):
        alone = seconds(item, item)
        if alone is None:
            raise ValueError(item)
        step = _Step(item, rates.index(interval), rates, _Known(seconds), item in splits)
        found: dict[tuple[int, ...], _State] = {}
        for state in states:
            for after in step.after(state):
                known = found.get(after.starts)
                if known is None or after.total < known.total - _TINY:
                    found[after.starts] = after
        states = _contenders(list(found.values()), rates, alone)
        if even and len(states) > 1:
            states = _undominated(states, [alone / every for every in rates])
    best = min(states, key=lambda state: state.total)
    return _requests(best, len(intervals) - 1, rates)


class _Known(dict[tuple[int, int], float | None]):
    """What an exchange costs, asked for once in each step."""

    def __init__(self, seconds: SecondsOf) -> None:
        super().__init__()
        self._seconds = seconds

    def __missing__(self, run: tuple[int, int]) -> float | None:
        found = self[run] = self._seconds(*run)
        return found


@dataclass(frozen=True, slots=True)
class _Step:
    """What may be done at one item."""

    item: int
    rate: int  # which of the intervals the item wants
    rates: Sequence[float]
    seconds: _Known
    split: bool

    def after(self, state: _State) -> list[_State]:
        """Every state that `state` can become: each open request goes on or ends, others begin."""
        ways = [_State((), state.paid, state.paid, state.done)]
        # Of the open requests only the fastest served the item before, so it alone may end there:
        # the others would have ended sooner. In the same way a request begins where it serves.
        fastest = next((r for r, start in enumerate(state.starts) if start != CLOSED), None)
        for rate, start in enumerate(state.starts):
            ends = rate == fastest
            ways = [more for way in ways for more in self._choices(way, rate, start, ends=ends)]
        return [way for way in ways if self._served(way)]

    def _choices(self, way: _State, rate: int, start: int, *, ends: bool) -> list[_State]:
        every = self.rates[rate]
        found = []
        closed = way
        if start != CLOSED:
            longer = None if self.split else self.seconds[start, self.item]
            if longer is not None:
                found.append(_extended(way, start, longer / every))
                if not ends:
                    return found
            spent = (self.seconds[start, self.item - 1] or 0.0) / every
            done = _Closed(Request(start, self.item - 1, every), way.done)
            closed = _State(way.starts, way.paid + spent, way.total + spent, done)
        if rate <= self.rate and not self._served(way):
            alone = self.seconds[self.item, self.item]
            if alone is not None:
                found.append(_extended(closed, self.item, alone / every))
        found.append(_State((*closed.starts, CLOSED), closed.paid, closed.total, closed.done))
        return found

    def _served(self, way: _State) -> bool:
        return any(start != CLOSED for start in way.starts[: self.rate + 1])


def _extended(way: _State, start: int, spent: float) -> _State:
    return _State((*way.starts, start), way.paid, way.total + spent, way.done)


def _contenders(states: list[_State], rates: Sequence[float], alone: float) -> list[_State]:
    """Those that could still win. From the cheapest one can go on as any other would by
    beginning its open requests afresh, for at most one exchange of a single item each."""
    best = min(state.total for state in states)

    def could_win(state: _State) -> bool:
        fresh = sum(
            alone / every
            for start, every in zip(state.starts, rates, strict=True)
            if start != CLOSED
        )
        return state.total < best + fresh - _TINY or state.total <= best + _TINY

    return [state for state in states if could_win(state)]


def _undominated(states: list[_State], fresh: Sequence[float]) -> list[_State]:
    """Without those that another can match by beginning afresh only where it has less room."""
    kept: list[_State] = []
    for state in sorted(states, key=lambda state: (state.total, [-s for s in state.starts])):
        limit = state.total + _TINY
        if not any(other.total + _to_match(other, state, fresh) <= limit for other in kept):
            kept.append(state)
    return kept


def _to_match(state: _State, other: _State, fresh: Sequence[float]) -> float:
    """What it costs at most to have as much room as `other` in all its open requests."""
    spent = 0.0
    for start, wanted, price in zip(state.starts, other.starts, fresh, strict=True):
        if wanted > start:  # CLOSED is below every start
            spent += price
    return spent


def _requests(state: _State, last: int, rates: Sequence[float]) -> list[Request]:
    found = [
        Request(start, last, every)
        for start, every in zip(state.starts, rates, strict=True)
        if start != CLOSED
    ]
    closed = state.done
    while closed is not None:
        found.append(closed.request)
        closed = closed.before
    return sorted(found)
