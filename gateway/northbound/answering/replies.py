"""Replies to queries, made on an answering thread: values, descriptions, status, outcomes."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import zenoh

from gateway.contract import payload
from gateway.contract.documents.catalogue import described
from gateway.contract.documents.introspection import introspection
from gateway.contract.interfaces import History, Parts, Plant
from gateway.contract.keys import Family, Keys, ParsedKey
from gateway.contract.meta import meta
from gateway.contract.past import buckets
from gateway.contract.past import samples as past
from gateway.contract.past.buckets import Bucket, Now
from gateway.contract.past.history_query import HistoryQuery, question
from gateway.contract.payload import Result
from gateway.contract.problems import Failure, Problem
from gateway.errors import BadValue, Busy, Damaged, GatewayError, NoHistory
from gateway.northbound.answering import pages
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.answering.turns import AnswerTurns, Pause, Rank
from gateway.northbound.publishing import encoding
from gateway.tags import Sample, Tag
from gateway.tags.recorded import Place, Recorded, RecordedQuery
from gateway.tags.sample import has_value

ANSWER_WITHIN = 60.0  # seconds for a whole answer of history; its client has gone after that
PAGE_WITHIN = 5.0  # seconds for a page
_TOO_LONG = f"this is not all: an answer ends after {ANSWER_WITHIN:g} s. Query in pages"
_INCOMPLETE = "the gateway is ending: this is not all"

_Row = tuple[str, str]  # the key of a reply, and its document


@dataclass(eq=False)
class Replies:
    """Every method replies to one query and may block while the client does not receive.

    `stamp` makes the session's time stamps. Each reply has its own, because an AdvancedSubscriber
    keeps only one of several samples with equal stamps.
    """

    _keys: Keys
    _plant: Plant
    _index: TagIndex
    _stamp: Callable[[], zenoh.Timestamp]
    _parts: Parts
    _signed: bool  # requests need the signature of a writer
    _ended: bool = False
    _turns: AnswerTurns = field(default_factory=AnswerTurns)
    _clock: Callable[[], float] = time.monotonic

    def end(self) -> None:
        """Makes a long answer stop at the next tag."""
        self._ended = True

    def current(self, parsed: ParsedKey, query: zenoh.Query) -> None:
        if parsed.family is Family.BLOCK:
            for device in self._index.devices_at(parsed.target):
                if device.blocks:
                    stamp = self._stamp()
                    block = payload.block(self._plant.sample(tag) for tag in device.tags)
                    self._reply(query, self._keys.block(device.name), block, stamp)
            return
        tags: Sequence[Tag] = self._index.tags_at(parsed.target)
        if len(tags) == 1 and not pages.is_paged(query):
            self._current(parsed.family, query, tags[0])
            return
        try:
            page = pages.page(query, self._keys.gateway)
            if page is not None:
                tags = pages.rest(tags, page.after)
            rest = None if page is None else tags[page.size :]
            with self._turns.turn(Rank.CURRENT) as pause:
                for tag in tags if page is None else tags[: page.size]:
                    if self._ended:
                        raise Busy(_INCOMPLETE)
                    self._current(parsed.family, query, tag)
                    pause()
            if page is not None and tags:
                sent = tags[: page.size]
                self._end_page(query, len(sent), sent[-1].key, complete=not rest)
        except GatewayError as error:
            self._failed(error, query)

    def _current(self, family: Family, query: zenoh.Query, tag: Tag) -> None:
        if family is Family.META:
            self._reply(query, self._keys.meta(tag.key), meta(tag), self._stamp())
        elif family is not Family.LAST or tag.device not in self._index.only_blocks:
            # An AdvancedSubscriber would keep a value whose key is never put.
            self._value(query, tag)

    def _value(self, query: zenoh.Query, tag: Tag) -> None:
        # Stamped before the look-up: a newer value that is put meanwhile has the newer stamp.
        stamp = self._stamp()
        sample = self._plant.sample(tag)
        encoding.reply(query, self._keys.value(tag.key), sample, stamp)

    def fresh(self, tags: Sequence[Tag], unread: Sequence[Tag], query: zenoh.Query) -> None:
        """Replies with current values, and with one error for all tags in `unread`."""
        for tag in tags:
            if tag not in unread:
                self._value(query, tag)
        if unread:
            more = f" and {len(unread) - 1} more" if len(unread) > 1 else ""
            reason = f"{unread[0].key}{more} could not be read in time"
            self.outcome(Failure(Problem.BUSY, reason), query)

    def history(self, parsed: ParsedKey, now: int, query: zenoh.Query) -> None:
        """`now`: ns since 1970, when the query was taken."""
        tags = self._index.tags_at(parsed.target)
        try:
            history = self._parts.history()
            if history is None:
                if tags:
                    raise NoHistory
                return  # they are another gateway's, which may have a history
            page = pages.page(query, self._keys.gateway)
            limit = _limit(query.parameters.get("limit"))
            asked = question(_parameters(query))
            with self._turns.turn(Rank.HISTORY) as pause:
                if asked.bucket is not None:
                    self._buckets(query, history, tags, asked, now, pause)
                elif page is None and (asked.last or limit is not None or len(tags) == 1):
                    by_tag = (past.samples(history, tag, asked, limit, now, pause) for tag in tags)
                    self._samples(query, past.one_by_one(by_tag), pause)
                elif tags:
                    wanted = {tag.recorded_key: tag for tag in tags}
                    place = pages.recorded_place(None if page is None else page.after)
                    recorded = RecordedQuery(wanted, asked.time_range, place, now)
                    found = history.as_recorded(recorded, pause)
                    self._as_recorded(query, found, page, pause, only_good=asked.only_good)
        except GatewayError as error:
            self._failed(error, query)

    def _buckets(
        self,
        query: zenoh.Query,
        history: History,
        tags: Sequence[Tag],
        asked: HistoryQuery,
        now: int,
        pause: Pause,
    ) -> None:
        until = self._clock() + ANSWER_WITHIN

        def go_on() -> None:
            self._go_on(until)
            pause()

        def of(tag: Tag) -> Iterator[tuple[Tag, Bucket]]:
            # A tag that is not read now has no valid value until now.
            moment = Now(now, is_valid=has_value(self._plant.sample(tag)))
            for bucket in history.buckets(tag, asked, moment, go_on):
                yield tag, bucket

        for tag, bucket in past.one_by_one(of(tag) for tag in tags):
            if bucket.quality == "good" or not asked.only_good:
                document = buckets.document(tag, bucket, asked.aggregates)
                self._reply(query, self._keys.value(tag.key), document, self._stamp())
            go_on()

    def _samples(self, query: zenoh.Query, found: Iterable[Sample], pause: Pause) -> None:
        until = self._clock() + ANSWER_WITHIN
        for sample in found:
            self._recorded(query, sample)
            self._go_on(until)
            pause()

    def _as_recorded(
        self,
        query: zenoh.Query,
        found: Recorded,
        page: pages.Page | None,
        pause: Pause,
        *,
        only_good: bool,
    ) -> None:
        until = self._clock() + (ANSWER_WITHIN if page is None else PAGE_WITHIN)
        last: Place = ("", 0, 0)
        count, again, lost, complete = 0, 0, None, False
        is_own = str(query.key_expr) == self._keys.status("page")
        batches = pages.Batches(
            lambda data: self._reply(query, self._keys.status("page/samples"), data, self._stamp())
        )
        for sample, place in found:
            if isinstance(sample, Damaged):
                lost = sample
            elif isinstance(sample, bool):
                complete = sample
            elif has_value(sample) or not only_good:
                self._recorded(query, sample, batches if is_own else None)
                count += 1
                again += place is None
            last = place or last
            if page is None or self._ended:
                self._go_on(until)
            elif place is not None and (count >= page.size or self._clock() > until):
                break
            pause()
        batches.end()
        if page is not None:
            self._end_page(query, count, last, complete=complete, again=again, lost=lost)
        elif lost is not None:
            raise lost

    def _recorded(
        self, query: zenoh.Query, sample: Sample, batches: pages.Batches | None = None
    ) -> None:
        key = self._keys.value(sample.tag.key)
        if batches is not None:  # as JSON: a bare value does not say its type of then
            batches.add(key, payload.value(sample))
        else:
            encoding.reply(query, key, sample, self._stamp())

    def _go_on(self, until: float) -> None:
        if self._ended:
            raise Busy(_INCOMPLETE)
        if self._clock() > until:
            raise Busy(_TOO_LONG)

    def _end_page(
        self,
        query: zenoh.Query,
        count: int,
        place: str | Place,
        *,
        complete: bool,
        again: int = 0,
        lost: Damaged | None = None,
    ) -> None:
        end = pages.end(self._keys.gateway, count, place, complete=complete, again=again, lost=lost)
        self._reply(query, self._keys.status("page"), end, self._stamp())

    def _failed(self, error: GatewayError, query: zenoh.Query) -> None:
        is_query = isinstance(error, BadValue)
        bad = Failure(Problem.BAD_QUERY, str(error))
        self.outcome(bad if is_query else payload.failure(error), query)

    def writes(self, now: int, query: zenoh.Query) -> None:
        """Replies with recorded outcomes, on the key of their publication; on the key of pages with
        the samples of all tags. `now` as in `history`."""
        if str(query.key_expr) == self._keys.status("page"):
            self.history(ParsedKey(Family.VALUE, self._keys.values), now, query)
            return
        key = self._keys.writes

        def found(time_range: str, limit: int | None) -> Iterator[_Row]:
            if (history := self._parts.history()) is None:
                raise NoHistory
            return ((key, row) for row in history.writes(time_range, limit, now))

        if query.key_expr.intersects(key):
            self._past(found, query)

    def entries(self, part: str, query: zenoh.Query) -> None:
        """Replies with the documents of a part."""
        try:
            with self._turns.turn(Rank.CURRENT) as pause:
                for path, make in self._parts.keyed(part).entries():
                    key = self._keys.status(f"{part}/{path}")
                    if not query.key_expr.intersects(key):
                        continue
                    if self._ended:
                        raise Busy(_INCOMPLETE)
                    self._reply(query, key, make(), self._stamp())
                    pause()
        except GatewayError as error:
            self._failed(error, query)

    def past_entries(self, part: str, now: int, query: zenoh.Query) -> None:
        """Replies with recorded documents, each on its key. `now` as in `history`."""

        def found(time_range: str, limit: int | None) -> Iterator[_Row]:
            rows = self._parts.keyed(part).recorded(time_range, now)
            keyed = ((self._keys.status(f"{part}/{path}"), row) for path, row in rows)
            return islice((one for one in keyed if query.key_expr.intersects(one[0])), limit)

        self._past(found, query)

    def _past(self, found: Callable[[str, int | None], Iterator[_Row]], query: zenoh.Query) -> None:
        try:
            limit = _limit(query.parameters.get("limit"))
            for key, row in found(query.parameters.get("_time") or "", limit):
                if self._ended:
                    raise Busy(_INCOMPLETE)
                self._reply(query, key, row.encode(), self._stamp())
        except GatewayError as error:
            self._failed(error, query)

    def status(self, documents: dict[str, bytes], query: zenoh.Query) -> None:
        for key, document in documents.items():
            if query.key_expr.intersects(key):
                self._reply(query, key, document, self._stamp())

    def own(self, query: zenoh.Query) -> None:
        """Replies with what the gateway says of itself."""
        if query.key_expr.intersects(self._keys.describe):
            self._reply(query, self._keys.describe, described(), self._stamp())
        if query.key_expr.intersects(self._keys.introspect):
            found = introspection(
                self._keys,
                self._plant.devices(),
                self._plant.commands(),
                signed=self._signed,
                history=self._has_history(),
            )
            self._reply(query, self._keys.introspect, payload.document(found), self._stamp())

    def _has_history(self) -> bool:
        try:
            return self._parts.history() is not None
        except Busy:  # it does not work now
            return True

    def outcome(self, result: Result, query: zenoh.Query) -> None:
        data = payload.outcome(result)
        if payload.failed(result) is not None:
            query.reply_err(data, encoding=zenoh.Encoding.APPLICATION_JSON)
        else:
            self._reply(query, str(query.key_expr), data, self._stamp())

    def _reply(self, query: zenoh.Query, key: str, data: bytes, stamp: zenoh.Timestamp) -> None:
        encoding.reply_json(query, key, data, stamp)


def _limit(text: str | None) -> int | None:
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise BadValue(f"limit={text[:40]} is no count such as 100")
    if not int(text):
        raise BadValue("limit is not between 1 and 1000000000")
    return int(text)


def _parameters(query: zenoh.Query) -> dict[str, str]:
    return dict(part.partition("=")[::2] for part in str(query.parameters).split(";") if part)
