"""The newest samples of a tag, found from the end of the history."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter

from gateway.contract.past.timerange import TimeRange
from gateway.parts.history.answers.recent import Recent
from gateway.parts.history.answers.search import StoredRuns
from gateway.parts.history.store.damage import Damage
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.rows import from_row
from gateway.tags import Sample, Tag
from gateway.tags.sample import has_value

_ORDER = itemgetter(0, 1)


@dataclass(eq=False)
class Newest:
    """Used by the answering threads."""

    _recent: Recent
    _reader: Reader
    _damage: Damage

    def of(
        self, tag: Tag, period: TimeRange, count: int, pause: Callable[[], None], *, only_good: bool
    ) -> Iterator[Sample]:
        """Yields the newest samples of the period, in the order of time. Raises `Damaged` at the
        end."""
        file, sorted_runs, newest = self._recent.find(tag.recorded_key)
        stored = StoredRuns(self._reader, self._damage, file, period)
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
