"""What the gateway hands its samples to, and what answers questions of the past."""

import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from heapq import merge
from itertools import islice
from os.path import realpath
from pathlib import Path

from gateway.errors import BadValue, Busy
from gateway.history.outcomes import Outcomes
from gateway.history.reader import Part, Reader, in_order
from gateway.history.recent import Recent, Shelved
from gateway.history.timerange import TimeRange, time_range
from gateway.history.writer import Writer
from gateway.tags import Sample, Tag
from gateway.tags.timestamps import rfc3339

LONGEST_RUN = 32_768  # samples
OLDEST_RUN = 600.0  # seconds
MOST_ASKED = 1_000_000_000  # samples, by `limit`


class Historian:
    """One history file and the thread that writes it.

    `record` and `record_write` belong to the event loop and never wait. Questions may come from
    any thread and see everything that was recorded before they were asked.
    """

    def __init__(
        self, path: Path, keep: float, max_size: int, wall: Callable[[], int] = time.time_ns
    ) -> None:
        """`keep`: seconds; `max_size`: bytes, the database's log included."""
        path = Path(realpath(path))  # SQLite has its log beside the file, not beside a link to it
        longest = max(256, min(LONGEST_RUN, max_size // 1024))
        self._wall = wall
        self._recent = Recent(longest, min(OLDEST_RUN, keep / 20))
        self._outcomes = Outcomes()
        self._reader = Reader(path)
        self._writer = Writer(
            path, keep, max_size, self._recent, self._outcomes, self._reader, wall
        )

    def start(self) -> None:
        """Begins to write. A file that cannot be opened is tried again: see `document`."""
        self._writer.start()

    def close(self, within: float = 2.0) -> bool:
        """Stores what waits. Blocks: not on the event loop. Whether all was done in time."""
        return self._writer.close(within)

    # -- event loop --

    def record(self, samples: Iterable[Sample]) -> None:
        """Keeps those of tags with `history: true`, in memory: whatever a disk does, or the thread
        that writes, is not felt here."""
        self._recent.add(samples)

    def record_write(self, time: int, outcome: str) -> None:
        """Records the outcome of a write as on the `writes` key; `time`: ns since 1970."""
        self._outcomes.add(time, outcome)

    def document(self) -> Mapping[str, object]:
        """For the status: `state` is `ok` or one sentence; counts since the start."""
        writer, recent = self._writer, self._recent
        oldest = min((run.first for run in recent.shelf), default=None)
        return {
            "state": writer.trouble or "ok",
            "recorded": recent.recorded,
            "stored": writer.stored,
            "waiting": recent.waiting,
            "lost": recent.lost,
            "writes_stored": self._outcomes.stored,
            "writes_lost": self._outcomes.lost,
            "bytes": writer.size,
            "oldest": None if oldest is None else rfc3339(oldest),
        }

    # -- any thread --

    def samples(
        self, tag: Tag, time_range: str, limit: int | None, now: int | None = None
    ) -> Iterator[Sample]:
        """The samples of a tag in a range of Zenoh's form, in the order of time.

        `now` is what the range means by it: ns since 1970, when it was asked. With a limit the
        first so many: the rest follows by asking again from the last one's time.
        Raises `BadValue` for a range or limit that cannot be understood, and `Busy`, also in the
        middle, when the file cannot be read now or what was not yet given out has been dropped:
        what came until then is not all there is.
        """
        wanted = self._range(time_range, limit, now)
        return islice(self._samples(tag, wanted, limit), limit)

    def writes(
        self, time_range: str, limit: int | None = None, now: int | None = None
    ) -> Iterator[str]:
        """Outcomes of writes as on the `writes` key (JSON), by the time they ended. Raises as
        `samples` does."""
        wanted = self._range(time_range, limit, now)
        return islice(self._writes(wanted), limit)

    def _range(self, text: str, limit: int | None, now: int | None) -> TimeRange:
        if limit is not None and not 1 <= limit <= MOST_ASKED:
            raise BadValue("limit is not between 1 and 1000000000")
        wanted = time_range(text, self._wall() if now is None else now)
        if not self._writer.readable:
            raise Busy(f"history cannot be read: {self._writer.trouble}")
        return wanted

    def _writes(self, wanted: TimeRange) -> Iterator[str]:
        pending = self._outcomes.pending(wanted)
        stored = self._reader.writes(pending.file, pending.last, wanted)
        try:
            for outcome in merge(stored, pending.outcomes, key=lambda outcome: outcome.time):
                yield outcome.told
        except (sqlite3.Error, OSError) as error:
            raise Busy(f"history cannot be read: {error}") from error

    def _samples(self, tag: Tag, wanted: TimeRange, limit: int | None) -> Iterator[Sample]:
        file, shelf, newest = self._recent.of(tag.key)
        runs = [run for run in shelf if run.first <= wanted.last and run.last >= wanted.first]
        begun = False

        def found(run: Shelved) -> list[Sample]:
            samples = self._reader.samples(file, tag, run, wanted, limit)
            if samples is None and begun:
                raise Busy("history has dropped meanwhile what was to come next: ask again")
            return samples or []  # gone before anything was said: as if asked a moment later

        parts = [Part(run.first, partial(found, run)) for run in runs]
        parts += [_part_of(run, wanted) for run in newest]
        try:
            for sample in in_order(parts):
                begun = True
                yield sample
        except (sqlite3.Error, OSError) as error:
            raise Busy(f"history cannot be read: {error}") from error


def _part_of(run: list[Sample], wanted: TimeRange) -> Part:
    found = [sample for sample in run if wanted.first <= sample.time <= wanted.last]
    found.sort(key=lambda sample: sample.time)
    return Part(found[0].time if found else wanted.first, lambda: found)
