"""The history of a gateway: records samples and outcomes, and answers queries of the past."""

import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator
from heapq import merge
from itertools import islice
from os.path import realpath
from pathlib import Path
from typing import NotRequired, TypeVar

from typing_extensions import TypedDict

from gateway.contract.documents.values import Time
from gateway.contract.past.buckets import Bucket, Now
from gateway.contract.past.history_query import HistoryQuery
from gateway.contract.past.timerange import TimeRange, time_range
from gateway.errors import BadValue, Busy, words_of
from gateway.parts.history.answers.bucket_search import BucketSearch
from gateway.parts.history.answers.outcomes import Outcome, Outcomes, Ring
from gateway.parts.history.answers.recent import Recent
from gateway.parts.history.answers.search import Search
from gateway.parts.history.store.reader import Reader
from gateway.parts.history.store.transfer import Retention, Transfer
from gateway.parts.history.store.writer import Writer
from gateway.tags import Sample, Tag
from gateway.tags.recorded import Recorded, RecordedQuery
from gateway.tags.timestamps import rfc3339

T = TypeVar("T")
LONGEST_RUN = 32_768  # samples
OLDEST_RUN = 600.0  # seconds
HIGHEST_LIMIT = 1_000_000_000  # samples


class HistoryDocument(TypedDict):
    """The history file. `state` is `ok` or one sentence. `room`: bytes that it may still grow;
    `free`: bytes on its disk."""

    state: str
    aside: list[str]
    recorded: int
    stored: int
    waiting: int
    lag: float
    lost: int
    writes_stored: int
    writes_lost: int
    refusals_stored: int
    refusals_lost: int
    alarms_stored: int
    alarms_lost: int
    bytes: int
    room: NotRequired[int]
    free: NotRequired[int | None]
    oldest: Time | None


class Historian:
    """One history file and the thread that writes it.

    `record` and `record_write` belong to the event loop and never wait. Queries may come from any
    thread and see everything that was recorded before.
    """

    def __init__(
        self, path: Path, keep: float, max_size: int, wall: Callable[[], int] = time.time_ns
    ) -> None:
        """`keep`: seconds; `max_size`: bytes, the database's log included."""
        path = Path(realpath(path))  # SQLite puts its log beside the file, not beside a link
        longest = max(256, min(LONGEST_RUN, max_size // 1024))
        self._wall = wall
        self._recent = Recent(longest, min(OLDEST_RUN, keep / 20))
        self._written, self._refused = Outcomes(Ring.WRITTEN), Outcomes(Ring.REFUSED)
        self._alarms = Outcomes(Ring.ALARMS)
        rings = self._written, self._refused, self._alarms
        self._reader = Reader(path)
        self._search = Search(self._recent, self._reader)
        self._course = BucketSearch(self._recent, self._reader, self._search.damage)
        self._retention = Retention(keep, max_size, self._recent, wall)
        self._transfer = Transfer(self._recent, rings, self._retention, wall)
        self._writer = Writer(path, max_size, self._transfer, self._reader)

    def start(self) -> None:
        """Starts to write. A file that cannot be opened is tried again: see `document`."""
        self._writer.start()

    def close(self, within: float = 2.0) -> bool:
        """Stores everything in memory; True if that was done in time. Blocks: not on the event
        loop."""
        return self._writer.close(within)

    # -- event loop --

    def record(self, samples: Iterable[Sample]) -> None:
        """Records the samples of tags with `history: true`, in memory: neither the disk nor the
        thread that writes can delay it."""
        self._recent.add(samples)

    def record_write(self, time: int, outcome: str, *, refused: bool) -> None:
        """Records the outcome of a write as on the `writes` key; `time`: ns since 1970. `refused`:
        by the gateway, and nothing was sent."""
        (self._refused if refused else self._written).add(time, outcome)

    def record_alarm(self, time: int, change: str) -> None:
        """Records one change of an alarm, as JSON; `time`: ns since 1970."""
        self._alarms.add(time, change)

    def document(self) -> HistoryDocument:
        """The status document: `state` is `ok` or one sentence; counts since the start."""
        recent = self._recent
        oldest = min((run.first for run in recent.sorted_runs), default=None)
        since = recent.waiting_since
        return {
            "state": self._writer.trouble
            or self._search.damage.sentence(recent.file, recent.sorted_runs)
            or "ok",
            "aside": [path.name for path in self._writer.aside],
            "recorded": recent.recorded,
            "stored": self._transfer.stored,
            "waiting": recent.waiting,
            "lag": 0.0 if since is None else round(max(0, self._wall() - since) / 1e9, 3),
            "lost": recent.lost,
            "writes_stored": self._written.stored,
            "writes_lost": self._written.lost,
            "refusals_stored": self._refused.stored,
            "refusals_lost": self._refused.lost,
            "alarms_stored": self._alarms.stored,
            "alarms_lost": self._alarms.lost,
            "bytes": self._retention.size,
            "room": self._retention.room,
            "free": self._retention.free,
            "oldest": None if oldest is None else rfc3339(oldest),
        }

    # -- any thread --

    def samples(
        self, tag: Tag, time_range: str, limit: int | None, now: int | None = None
    ) -> Iterator[Sample]:
        """Yields the samples of a tag in a Zenoh time range, in the order of time.

        `now` is the `now()` of the range, in ns since 1970. `limit` ends the answer early; another
        query from the last sample's time returns the rest.
        Raises `BadValue` for a bad range or limit, and `Busy`, also in the middle, when the file
        cannot be read now or the next samples were dropped: the answer is then incomplete. Raises
        `Damaged` at the end when a part of the file was left out.
        """
        period = self._range(time_range, limit, now)
        return islice(_readable(self._search.by_time(tag, period)), limit)

    def buckets(
        self, tag: Tag, question: HistoryQuery, now: Now, pause: Callable[[], None]
    ) -> Iterator[Bucket]:
        """Yields the buckets of a tag in the order of time; nothing for a tag without samples.

        Calls `pause` often. Raises like `samples`; `BadValue` for too many buckets, too.
        """
        width = question.bucket
        if width is None:
            raise BadValue("a bucket is missing, such as bucket=1min")
        period = self._range(question.time_range, None, now.time)
        of_tag = self._course.buckets(
            tag, period, width, now, pause, from_start=question.from_start
        )
        return _readable(of_tag)

    def newest(
        self, tag: Tag, question: HistoryQuery, now: int, pause: Callable[[], None]
    ) -> Iterator[Sample]:
        """Yields the newest samples of the range in the order of time. Raises like `samples`."""
        period = self._range(question.time_range, question.last, now)
        count = question.last or HIGHEST_LIMIT
        found = self._search.newest(tag, period, count, pause, only_good=question.only_good)
        return _readable(found)

    def as_recorded(self, query: RecordedQuery, pause: Callable[[], None]) -> Recorded:
        """Yields samples as `Search.as_recorded` does. Raises `BadValue`, `Busy`."""
        period = self._range(query.time_range, None, query.now)
        return _readable(self._search.as_recorded(query, period, pause))

    def writes(
        self, time_range: str, limit: int | None = None, now: int | None = None
    ) -> Iterator[str]:
        """Yields outcomes of writes as on the `writes` key (JSON), in the order of time. Raises
        like `samples`."""
        period = self._range(time_range, limit, now)
        return islice(self._outcomes((self._written, self._refused), period), limit)

    def alarms(
        self, time_range: str, limit: int | None = None, now: int | None = None
    ) -> Iterator[str]:
        """Yields changes of alarms (JSON), in the order of time. Raises like `samples`."""
        period = self._range(time_range, limit, now)
        return islice(self._outcomes((self._alarms,), period), limit)

    def _range(self, text: str, limit: int | None, now: int | None) -> TimeRange:
        if limit is not None and not 1 <= limit <= HIGHEST_LIMIT:
            raise BadValue("limit is not between 1 and 1000000000")
        period = time_range(text, self._wall() if now is None else now)
        if not self._writer.readable:
            raise Busy(f"history cannot be read: {self._writer.trouble}")
        return period

    def _outcomes(self, rings: Iterable[Outcomes], period: TimeRange) -> Iterator[str]:
        found = list[Iterable[Outcome]]()
        for outcomes in rings:
            pending = outcomes.pending(period)
            stored = self._reader.writes(outcomes.ring, pending.file, pending.last, period)
            found += (stored, pending.outcomes)
        for outcome in _readable(merge(*found, key=lambda outcome: outcome.time)):
            yield outcome.text


def _readable(found: Iterator[T]) -> Iterator[T]:
    try:
        yield from found
    except (sqlite3.Error, OSError) as error:
        raise Busy(f"history cannot be read: {words_of(error)}") from error
