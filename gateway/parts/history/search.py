"""Finds samples in the file and in memory: of one tag by time, or of many as they were recorded."""

from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from functools import partial

from gateway.contract.timerange import EARLIEST, LATEST, TimeRange
from gateway.errors import Busy, Damaged
from gateway.parts.history import sections
from gateway.parts.history.damage import Damage
from gateway.parts.history.reader import Part, Reader, in_order
from gateway.parts.history.recent import Identity, Recent, SortedRun
from gateway.parts.history.rows import Stored, from_row
from gateway.parts.history.sections import FullRow
from gateway.tags import Sample, Tag
from gateway.tags.recorded import Place, Recorded, RecordedQuery
from gateway.tags.timestamps import rfc3339

_MANY = 2048  # samples in memory between two pauses
_ALL = range(2**31)  # the numbers of all tags
_Placed = tuple[int, Tag, int, Stored, int | None, str | None]  # a row with its number and tag


class Search:
    """Used by the answering threads. What a damaged file still has is answered first."""

    def __init__(self, recent: Recent, reader: Reader, damage: Damage | None = None) -> None:
        self.damage = damage or Damage()
        self._recent = recent
        self._reader = reader

    def by_time(self, tag: Tag, period: TimeRange) -> Iterator[Sample]:
        """Yields the samples of a tag in the order of time. Raises `Busy`, and at the end
        `Damaged`."""
        file, sorted_runs, newest = self._recent.find(tag.key)
        stored = StoredRuns(self._reader, self.damage, file, period)
        runs = stored.of(sorted_runs)
        numbers = stored.numbers({tag.key: tag}, runs)
        begun = False

        def read(run: SortedRun) -> Iterator[Sample]:
            for rows in stored.rows(run, numbers):
                if rows is None:
                    if begun:
                        raise Busy("the next samples were dropped meanwhile: ask again")
                    return  # dropped before the first sample: as if queried a moment later
                for number, time, _, value, kind, bad in rows:
                    if number in numbers and period.first <= time <= period.last:
                        yield from_row(tag, time, value, kind, bad)

        parts = [Part(run.first, partial(read, run)) for run in runs]
        parts += [_part_of(run, period) for run in newest]
        for sample in in_order(parts):
            begun = True
            yield sample
        if (lost := stored.lost()) is not None:
            raise lost

    def as_recorded(
        self, query: RecordedQuery, period: TimeRange, pause: Callable[[], None]
    ) -> Recorded:
        """Yields the samples of many tags in the order of recording, each with its place.

        `Damaged` is yielded after the rest of a damaged run. Samples without a place in the file
        come last, without a place: a later search finds them again. The last pair has True, or
        False before a run that would pass `page` samples: it is not read twice then. Raises `Busy`;
        calls `pause` at least every few milliseconds of reading.
        """
        tags, page = query.tags, query.page
        file, sorted_runs, newest = self._recent.content()
        mark = _mark(file)
        (_, begin, first), period = _start(query.after, mark, period)
        stored = StoredRuns(self._reader, self.damage, file, period)
        runs = [run for run in sorted_runs if run.number >= begin]
        numbers = stored.numbers(tags, stored.of(runs))
        place, found, of_last_run = (mark, begin, max(first - 1, 0)), 0, 0
        for run in runs:
            if page is not None and 0 < found > page - of_last_run:
                yield False, place
                return
            skipped = first if run.number == begin else 0
            if skipped < run.samples and stored.of([run]):
                placed = stored.placed(run, numbers, pause)
                if placed is None and found:
                    raise Busy("the next samples were dropped meanwhile: ask again")
                rows = [row for row in (placed or [])[skipped:] if row is not None]
                of_last_run = len(rows)
                found += of_last_run
                for row in rows:
                    yield from_row(*row[1:]), (mark, run.number, row[0])
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

    def check(self) -> Iterator[None]:
        """Reads all sorted runs once, a part for each step, and notes the damage. Raises `Busy`
        and `sqlite3.Error`."""
        file, sorted_runs, _ = self._recent.content()
        for run in sorted_runs:
            try:
                listed = self._reader.listed(file, run)
                for group in sections.groups(listed, _ALL, TimeRange(EARLIEST, LATEST)):
                    if self._reader.rows(file, run, group) is None:
                        break  # dropped
                    yield
            except Damaged as error:
                self.damage.found(file, run, str(error))


class StoredRuns:
    """The sorted runs, for one answer."""

    def __init__(
        self, reader: Reader, damage: Damage, file: Identity | None, period: TimeRange
    ) -> None:
        self._reader = reader
        self._damage = damage
        self._file = file
        self.period = period
        self.damaged: list[SortedRun] = []  # since the last call of `lost`

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

    def rows(self, run: SortedRun, numbers: Collection[int]) -> Iterator[list[FullRow] | None]:
        """Yields rows of the run in the order of tag and time, at least those of the tags; None if
        it was dropped. Leaves out damaged sections."""
        try:
            groups = sections.groups(self._reader.sections(self._file, run), numbers, self.period)
        except Damaged as error:
            self._note(run, error)
            return
        while groups:
            group = groups.pop(0)
            try:
                found = self._reader.rows(self._file, run, group)
            except Damaged as error:
                if len(group) > 1:
                    groups = [[section] for section in group] + groups
                else:
                    self._note(run, error)
                continue
            yield found
            if found is None:
                return

    def placed(
        self, run: SortedRun, numbers: Mapping[int, Tag], pause: Callable[[], None]
    ) -> list[_Placed | None] | None:
        """Returns the found rows of a run, each at its number: sorting would take longer. None if
        it was dropped."""
        first, last = self.period
        placed: list[_Placed | None] = [None] * run.samples
        for rows in self.rows(run, numbers):
            if rows is None:
                return None
            for number, time, n, value, kind, bad in rows:
                tag = numbers.get(number)
                if tag is not None and first <= time <= last and n < run.samples:
                    placed[n] = n, tag, time, value, kind, bad
            pause()
        return placed

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
        if sample.tag.key in tags and period.first <= sample.time <= period.last:
            yield n, sample
        elif n % _MANY == 0:
            pause()


def _mark(file: Identity | None) -> str:
    """A copy of a file has another mark here: it may get other samples in runs of one number."""
    return "" if file is None else f"{file.inode:x}.{file.mark[:4].hex()}"


def _start(after: Place | None, mark: str, period: TimeRange) -> tuple[Place, TimeRange]:
    """Returns the first place and the period of a search. The clock may have been set back since
    `after`."""
    if after is None or after[0] != mark:
        return (mark, 0, 0), period
    return (mark, after[1], after[2] + 1), TimeRange(EARLIEST, period.last)


def _part_of(run: list[Sample], period: TimeRange) -> Part:
    found = [sample for sample in run if period.first <= sample.time <= period.last]
    found.sort(key=lambda sample: sample.time)
    return Part(found[0].time if found else period.first, lambda: found)
