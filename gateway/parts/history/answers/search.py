"""Finds samples in the file and in memory: of one tag by time, or of many as they were recorded."""

from bisect import bisect_left
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import itemgetter

from gateway.contract.past.timerange import EARLIEST, TimeRange
from gateway.errors import Busy, Damaged
from gateway.parts.history.answers.recent import Identity, Recent, SortedRun
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.index import GROUP, Places
from gateway.parts.history.store.reader import Reader, SampleSource, in_order
from gateway.parts.history.store.rows import StoredRow, from_row
from gateway.tags import Sample, Tag
from gateway.tags.recorded import Place, Recorded, RecordedQuery
from gateway.tags.sample import has_value
from gateway.tags.timestamps import rfc3339

_MANY = 2048  # samples in memory between two pauses
_LOST = 16  # samples that are lost together
_FEW_TAGS = 100  # for more, a run is read as a whole
_TIME = itemgetter(2)
_ORDER = itemgetter(0, 1)


class Search:
    """Used by the answering threads. What a damaged file still has is answered first."""

    def __init__(self, recent: Recent, reader: Reader, damage: Damage | None = None) -> None:
        self.damage = damage or Damage()
        self._recent = recent
        self._reader = reader

    def by_time(self, tag: Tag, period: TimeRange) -> Iterator[Sample]:
        """Yields the samples of a tag in the order of time. Raises `Busy`, and at the end
        `Damaged`."""
        file, sorted_runs, newest = self._recent.find(tag.recorded_key)
        stored = StoredRuns(self._reader, self.damage, file, period)
        runs = stored.of(sorted_runs)
        numbers = stored.numbers({tag.recorded_key: tag}, runs)
        begun = False

        def group(run: SortedRun, places: Places) -> list[Sample]:
            found = stored.read(run, numbers, places.numbers)
            if found is None and begun:
                raise Busy("the next samples were dropped meanwhile: ask again")
            # Dropped before the first sample: as if queried a moment later.
            return [from_row(tag, *row[2:6]) for row in sorted(found or (), key=_TIME)]

        def read(run: SortedRun) -> Iterator[Sample]:
            groups = stored.places(run, numbers)
            return in_order(SampleSource(each.first, partial(group, run, each)) for each in groups)

        parts = [SampleSource(run.first, partial(read, run)) for run in runs]
        parts += [_part_of(run, period) for run in newest]
        for sample in in_order(parts):
            begun = True
            yield sample
        if (lost := stored.lost()) is not None:
            raise lost

    def newest(
        self, tag: Tag, period: TimeRange, count: int, pause: Callable[[], None], *, only_good: bool
    ) -> Iterator[Sample]:
        """Yields the newest samples of the period, in the order of time. Raises `Damaged` at the
        end."""
        file, sorted_runs, newest = self._recent.find(tag.recorded_key)
        stored = StoredRuns(self._reader, self.damage, file, period)
        runs = stored.of(sorted_runs)
        numbers = stored.numbers({tag.recorded_key: tag}, runs)
        # The order of recording decides between samples of one time.
        found = [
            (sample.time, len(runs) + place, sample)
            for place, run in enumerate(newest)
            for sample in run
            if period.first <= sample.time <= period.last and (has_value(sample) or not only_good)
        ]
        found = sorted(found, key=_ORDER)[-count:]
        for place, run in sorted(enumerate(runs), key=lambda run: run[1].last, reverse=True):
            if len(found) == count and found[0][0] > run.last:
                break
            for rows in stored.rows(run, numbers):
                found += [
                    (time, place, sample)
                    for _, _, time, value, kind, bad, _ in rows or ()
                    if has_value(sample := from_row(tag, time, value, kind, bad)) or not only_good
                ]
                pause()
            found = sorted(found, key=_ORDER)[-count:]
        for _, _, sample in found:
            yield sample
        if (lost := stored.lost()) is not None:
            raise lost

    def as_recorded(
        self, query: RecordedQuery, period: TimeRange, pause: Callable[[], None]
    ) -> Recorded:
        """Yields the samples of many tags in the order of recording, each with its place.

        `Damaged` is yielded after the rest of a damaged run. Samples without a place in the file
        come last, without a place: a later search finds them again. The last pair has True. Raises
        `Busy`; calls `pause` at least every few milliseconds of reading.
        """
        tags = query.tags
        file, sorted_runs, newest = self._recent.content()
        mark = _mark(file)
        places = [run.number for run in sorted_runs] + [number for number, *_ in newest if number]
        (_, begin, first), period = _start(query.after, mark, period, places)
        stored = StoredRuns(self._reader, self.damage, file, period)
        runs = [run for run in sorted_runs if run.number >= begin]
        numbers = stored.numbers(tags, stored.of(runs))
        place, found = (mark, begin, max(first - 1, 0)), False
        yield from _missed(query.after, place, places)
        for run in runs:
            skipped = first if run.number == begin else 0
            if skipped < run.samples and stored.of([run]):
                for rows in stored.rows(run, numbers, skipped):
                    if rows is None and found:
                        raise Busy("the next samples were dropped meanwhile: ask again")
                    for number, tag, time, value, kind, bad, _ in rows or ():
                        found = True
                        sample = from_row(numbers[tag], time, value, kind, bad)
                        yield sample, (mark, run.number, number - run.number)
                    pause()
            place = mark, run.number, max(skipped, run.samples) - 1
            if (lost := stored.lost()) is not None:
                yield lost, place
        for number, samples, count in newest:
            skipped = first if number == begin else 0
            for n, sample in _found(samples, range(skipped, count), tags, period, pause):
                yield sample, (mark, number, n) if number else None
            if number:
                place = mark, number, max(skipped, count) - 1
        yield True, place


@dataclass(eq=False)
class StoredRuns:
    """The sorted runs, for one answer."""

    _reader: Reader
    _damage: Damage
    _file: Identity | None
    period: TimeRange
    damaged: list[SortedRun] = field(default_factory=list)  # since the last call of `lost`

    def of(self, runs: Iterable[SortedRun]) -> list[SortedRun]:
        """Returns the runs with samples in the period."""
        first, last = self.period
        return [run for run in runs if run.first <= last and run.last >= first]

    def numbers(self, tags: Mapping[str, Tag], runs: Sequence[SortedRun]) -> dict[int, Tag]:
        """Returns the tags by their numbers in the file."""
        if not runs:
            return {}
        try:
            known, lack = self._reader.tags(self._file)
        except Damaged:
            known, lack = {}, True
        if lack and not tags.keys() <= known.keys():
            for run in runs:
                self._note(run, Damaged("the name of a tag is damaged"))
        return {known[key]: tag for key, tag in tags.items() if key in known}

    def places(self, run: SortedRun, numbers: Collection[int]) -> list[Places]:
        """Returns the samples of the run to read, in their order."""
        try:
            return self._reader.index(self._file, run).places(numbers, self.period, _FEW_TAGS)
        except Damaged:
            groups = (range(at, at + GROUP) for at in range(0, run.samples, GROUP))
            return [Places(run.first, group[: run.samples - group[0]]) for group in groups]

    def rows(
        self, run: SortedRun, numbers: Collection[int], first: int = 0
    ) -> Iterator[list[StoredRow] | None]:
        """Yields the rows of the tags in the period, in the order of recording, from the `first`
        sample of the run on; None if the run was dropped. Leaves out what is damaged."""
        for _, places in self.places(run, numbers):
            if wanted := places[bisect_left(places, first) :]:
                yield (found := self.read(run, numbers, wanted))
                if found is None:
                    return

    def read(
        self, run: SortedRun, numbers: Collection[int], places: Sequence[int]
    ) -> list[StoredRow] | None:
        """Returns the rows of the tags in the period, at these places; None if the run was
        dropped. Leaves out what is damaged."""
        begin, end = self.period
        try:
            found = self._reader.rows(self._file, run, places)
        except Damaged as error:
            size = max(1, len(places) // 8)
            if size < _LOST:
                self._note(run, error)
                return []
            parts = (places[at : at + size] for at in range(0, len(places), size))
            return [row for part in parts for row in self.read(run, numbers, part) or ()]
        if found is None:
            return None
        if found[1]:
            self._note(run, Damaged("samples are lost"))
        return [row for row in found[0] if row[1] in numbers and begin <= row[2] <= end]

    def lost(self) -> Damaged | None:
        """Returns an error if parts were left out since the last call."""
        damaged, self.damaged = self.damaged, []
        if not damaged:
            return None
        first = rfc3339(min(run.first for run in damaged))
        last = rfc3339(max(run.last for run in damaged))
        return Damaged(f"samples between {first} and {last} are lost: the file is damaged there")

    def _note(self, run: SortedRun, error: Damaged) -> None:
        self._damage.found(self._file, run, str(error))
        self.damaged.append(run)


def _found(
    samples: Sequence[Sample],
    numbers: Iterable[int],
    tags: Container[str],
    period: TimeRange,
    pause: Callable[[], None],
) -> Iterator[tuple[int, Sample]]:
    """Yields the samples of a run in memory, with their numbers."""
    for n in numbers:
        sample = samples[n]
        if sample.tag.recorded_key in tags and period.first <= sample.time <= period.last:
            yield n, sample
        elif n % _MANY == 0:
            pause()


def _missed(after: Place | None, begin: Place, runs: Sequence[int]) -> Recorded:
    """Yields `Damaged` if samples after the place were deleted to make room, or are others now."""
    if after is None or after[0] != begin[0] or not runs:
        return
    if not _is_known(after, runs):
        yield Damaged("the file is an older copy: it is read from its beginning"), begin
    elif (count := runs[0] - after[1] - after[2] - 1) > 0:
        yield Damaged(f"{count} samples were deleted unread"), begin


def _is_known(place: Place, runs: Sequence[int]) -> bool:
    """Returns False if the file had the run, and has only earlier and later ones now: the disk is
    that of an earlier day."""
    return place[1] in runs or all(run > place[1] for run in runs)


def _mark(file: Identity | None) -> str:
    """A copy of a file has another mark here: it may get other samples in runs of one number."""
    return "" if file is None else f"{file.inode:x}.{file.mark[:4].hex()}"


def _start(
    after: Place | None, mark: str, period: TimeRange, runs: Sequence[int]
) -> tuple[Place, TimeRange]:
    """Returns the first place and the period of a search. The clock may have been set back since
    `after`."""
    if after is None or after[0] != mark or not _is_known(after, runs):
        return (mark, 0, 0), period
    return (mark, after[1], after[2] + 1), TimeRange(EARLIEST, period.last)


def _part_of(run: list[Sample], period: TimeRange) -> SampleSource:
    found = [sample for sample in run if period.first <= sample.time <= period.last]
    found.sort(key=lambda sample: sample.time)
    return SampleSource(found[0].time if found else period.first, lambda: found)
