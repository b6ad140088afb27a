"""The course of one tag: when which value was valid, for buckets.

A value is valid until the next sample of its tag, as long as a gateway ran. A start is recorded. So
the value before it is valid until the last sample of any tag that was recorded before the start.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import merge
from operator import itemgetter
from typing import NamedTuple

from gateway.contract.past.buckets import MOST_BUCKETS, NOT_RECORDED, Bucket, Now, Step, buckets
from gateway.contract.past.timerange import EARLIEST, LATEST, TimeRange
from gateway.errors import Busy, Damaged
from gateway.parts.history.answers.recent import Identity, Recent, SortedRun
from gateway.parts.history.answers.search import StoredRuns
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.rows import step
from gateway.tags import Quality, Reason, Sample, Tag

_MOST = math.inf
DAMAGED = "damaged"  # samples of this time are lost
Pause = Callable[[], None]
_TIME = itemgetter(0)


class _Part(NamedTuple):
    """Steps of one run. `last`: no step is later."""

    first: int
    last: int
    steps: Callable[[], list[Step]]


@dataclass(eq=False)
class BucketSearch:
    """Used by the answering threads."""

    _recent: Recent
    _reader: Reader
    _damage: Damage
    _most: int = MOST_BUCKETS

    def buckets(
        self,
        tag: Tag,
        period: TimeRange,
        width: int,
        now: Now,
        pause: Pause,
        *,
        from_start: bool = False,
    ) -> Iterator[Bucket]:
        """Yields the buckets of a tag. Raises `BadValue`, `Busy`, and at the end `Damaged`."""
        file, runs, newest = self._recent.find(tag.recorded_key)
        stored = StoredRuns(self._reader, self._damage, file, period)
        numbers = stored.numbers({tag.recorded_key: tag}, runs)
        look = _Look(self._recent, self._reader, self._damage, file, runs, newest, numbers, period)
        begin = look.before()
        parts = list[_Part]()  # in the order of recording
        for run in stored.of(runs) if numbers or stored.damaged else ():
            first, last = _extent(run, runs)
            if first <= period.last and last >= period.first:
                parts.append(_part(stored, run, (first, last), numbers, pause))
            elif begin[0] <= last < period.first:
                begin = begin[0], None, DAMAGED
        parts += [_in_memory(samples) for run in newest if (samples := _steps_of(run, period))]
        steps = _with_gaps(begin, _merged(parts), look, now)
        yield from buckets(steps, width, period, now.time, self._most, from_start=from_start)
        if (lost := stored.lost()) is not None:
            raise lost


def _with_gaps(begin: Step, steps: Iterator[Step], look: "_Look", now: Now) -> Iterator[Step]:
    """Adds the time without a gateway."""
    last, value, _ = begin
    if last > EARLIEST:
        yield begin
    for found in steps:
        if found[2] == Reason.STARTING and value is not None:
            yield look.gap(last, found[0])
        yield found
        last, value, _ = found
    if value is None:
        return
    follows = None if look.period.last >= now.time else look.after()
    if follows is not None:
        if follows[2] in (Reason.STARTING, DAMAGED):
            yield look.gap(last, follows[0])
    elif not now.is_valid:
        yield look.gap(last, now.time)


class _Look(NamedTuple):
    """Finds the neighbours of a period: the samples of the tag before it and after it."""

    recent: Recent
    reader: Reader
    damage: Damage
    file: Identity | None
    runs: Sequence[SortedRun]
    newest: Sequence[Sequence[Sample]]
    numbers: dict[int, Tag]
    period: TimeRange

    def gap(self, last: int, before: int) -> Step:
        """Returns the gap after the last sample of any tag. `last`: the last one of this tag."""
        times = [last, self.recent.latest_before(before)]
        for run in self.runs:
            if run.last < before:
                times.append(run.last)
            elif run.first < before:  # a changed file was loaded while the gateway ran
                with suppress(Damaged):
                    times.append(self.reader.latest_before(self.file, run, before) or last)
        return max(times), None, NOT_RECORDED

    def before(self) -> Step:
        """Returns the last step before the period; `EARLIEST` if there is none."""
        first = self.period.first
        in_memory: Step = (EARLIEST, None, NOT_RECORDED)
        for run in self.newest:
            for sample in run:
                if in_memory[0] <= sample.time < first:
                    in_memory = _step_of(sample)
        found = self._stored(first, later=False)
        return found[-1] if found and found[-1][0] > in_memory[0] else in_memory

    def after(self) -> Step | None:
        """Returns the first step after the period."""
        last = self.period.last
        in_memory = [_step_of(s) for run in self.newest for s in run if s.time > last]
        return min([*self._stored(last, later=True)[:1], *in_memory], key=_TIME, default=None)

    def _stored(self, time: int, *, later: bool) -> list[Step]:
        """Returns the steps in the file at the nearest time; a gap if they may be lost."""
        nearest: list[Step] = []
        for run in self._by_distance(time, later=later):
            if nearest and (run.first > nearest[0][0] if later else run.last < nearest[0][0]):
                break
            period = TimeRange(time + 1, LATEST) if later else TimeRange(EARLIEST, time - 1)
            stored = StoredRuns(self.reader, self.damage, self.file, period)
            found = _rows(stored, run, self.numbers, lambda: None)
            if stored.damaged:
                return [(time, None, DAMAGED)]
            if found:
                at = (min if later else max)(found, key=_TIME)[0]
                found = [step for step in found if step[0] == at]
                if not nearest or (at < nearest[0][0] if later else at > nearest[0][0]):
                    nearest = found
                elif at == nearest[0][0]:  # of steps of one time the order of recording decides
                    nearest = nearest + found if later else found + nearest
        return nearest

    def _by_distance(self, time: int, *, later: bool) -> list[SortedRun]:
        """Returns the runs with samples after the time, or before it; the nearest first."""
        if not self.numbers:
            return []
        if later:
            runs = (run for run in self.runs if run.last > time)
            return sorted(runs, key=lambda run: (run.first, run.number))
        runs = (run for run in self.runs if run.first < time)
        return sorted(runs, key=lambda run: (run.last, run.number), reverse=True)


def _extent(run: SortedRun, runs: Sequence[SortedRun]) -> tuple[int, int]:
    """Returns the first and last time of a run. One whose row is lost is between its neighbours."""
    if run.last < LATEST:
        return run.first, run.last
    place = runs.index(run)
    ends = [other.last for other in runs[:place] if other.last < LATEST]
    begins = [other.first for other in runs[place + 1 :] if other.last < LATEST]
    known = [*ends[-1:], *begins[:1]]
    return (min(known), max(known)) if known else (LATEST, EARLIEST)


def _part(
    stored: StoredRuns,
    run: SortedRun,
    extent: tuple[int, int],
    numbers: dict[int, Tag],
    pause: Pause,
) -> _Part:
    def steps() -> list[Step]:
        found = _rows(stored, run, numbers, pause)
        if run in stored.damaged:  # no value is valid over samples that are lost
            return [(max(extent[0], stored.period.first), None, DAMAGED)]
        return found

    return _Part(*extent, steps)


def _rows(stored: StoredRuns, run: SortedRun, numbers: dict[int, Tag], pause: Pause) -> list[Step]:
    """Returns the steps of a run in the order of time."""
    found: list[Step] = []
    for rows in stored.rows(run, numbers):
        if rows is None:
            raise Busy("the next samples were dropped meanwhile: ask again")
        found += [
            (time, value, None)
            if bad is None and kind is None and value.__class__ is float and -_MOST < value < _MOST
            else step(time, value, kind, bad)
            for _, _, time, value, kind, bad, _ in rows
        ]
        pause()
    found.sort(key=_TIME)
    return found


def _steps_of(run: list[Sample], period: TimeRange) -> list[Step]:
    found = [_step_of(sample) for sample in run if _is_in(period, sample.time)]
    found.sort(key=_TIME)
    return found


def _in_memory(steps: list[Step]) -> _Part:
    return _Part(steps[0][0], steps[-1][0], lambda: steps)


def _step_of(sample: Sample) -> Step:
    reason = None if sample.quality is Quality.GOOD else sample.reason or ""
    return step(sample.time, sample.value, None, None if reason is None else str(reason))


def _merged(parts: Sequence[_Part]) -> Iterator[Step]:
    """Yields the steps of all parts by time. Parts overlap only after the clock was set back; of
    steps of one time, the last one in the order of recording comes last."""
    waiting = sorted(enumerate(parts), key=lambda part: part[1].first)
    place = 0
    while place < len(waiting):
        together, last = [waiting[place]], waiting[place][1].last
        place += 1
        while place < len(waiting) and waiting[place][1].first <= last:
            together.append(waiting[place])
            last = max(last, waiting[place][1].last)
            place += 1
        steps = [part.steps() for _, part in sorted(together, key=_TIME)]
        yield from merge(*steps, key=_TIME) if len(steps) > 1 else steps[0]


def _is_in(period: TimeRange, time: int) -> bool:
    return period.first <= time <= period.last
