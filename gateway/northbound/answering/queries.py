"""Answers or refuses each query from the network, and always finishes it.

The event loop sorts them, waits for the plant where it must, and hands the replies to the
answering threads.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from functools import partial

import structlog
import zenoh

from gateway.contract import payload
from gateway.contract.interfaces import Parts, Plant
from gateway.contract.keys import Family, ParsedKey, max_age, parse_key, part_of
from gateway.contract.parsing import check_encoding
from gateway.contract.past.history_query import is_of_past
from gateway.contract.payload import Result
from gateway.contract.problems import Failure, Problem
from gateway.engine.jobs.requests import Peeked
from gateway.errors import BadValue, Busy, GatewayError
from gateway.northbound.answering.answers import Answer, AnswerPool, QueryCounters
from gateway.northbound.answering.replies import Replies
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.requests.acceptance import encoding_of, sender
from gateway.northbound.requests.commands import Commands, Orders
from gateway.northbound.requests.inbox import Inbox
from gateway.northbound.requests.writes import ANSWER_WITHIN, Writes
from gateway.tags import Tag

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

StatusDocuments = Callable[[], Awaitable[dict[str, bytes]]]  # by full key

FRESH_LIMIT = 256  # tags that one query may have read from the devices
_BUSY = Failure(Problem.BUSY, "too many queries are waiting; nothing was done")
_LONGEST_RANGE = 100  # characters
_MOST_PARTS = 2  # `$*` in one part of a key: to match one more takes up to 60 times as long
_TOO_WILD = Failure(Problem.BAD_QUERY, f"a part of the key has more than {_MOST_PARTS} times $*")
_ENDING = Failure(Problem.UNCLEAR, "the gateway is ending")


@dataclass(eq=False)
class Queries:
    """Takes queries on the event loop and finishes each of them."""

    _plant: Plant
    _index: TagIndex
    _writes: Writes
    _commands: Commands
    _replies: Replies
    _documents: StatusDocuments
    _orders: Orders
    _parts: Parts
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def __post_init__(self) -> None:
        busy = partial(self._replies.outcome, _BUSY)
        # Reads take neither the places nor the threads of writes.
        self._reads, self._requests = AnswerPool(busy), AnswerPool(busy)

    @property
    def counters(self) -> QueryCounters:
        one, other = self._reads.counters, self._requests.counters
        return QueryCounters(one.queries + other.queries, one.refused + other.refused)

    def inbox(self) -> Callable[[zenoh.Query], None]:
        """Returns the entry for Zenoh's thread: reads wait for the loop apart from requests."""
        reads, requests = (Inbox(self.take, self.refuse) for _ in range(2))

        def taken(query: zenoh.Query) -> None:
            is_request = _is_request(query, parse_key(str(query.key_expr)))
            (requests if is_request else reads)(query)

        return taken

    def refuse(self, query: zenoh.Query) -> None:
        """Called on Zenoh's thread when the inbox is full."""
        parsed = parse_key(str(query.key_expr))
        pool = self._pool(query, parsed)
        if self._is_foreign(parsed):
            pool.dismiss(query)
        else:
            pool.refuse(query)

    def take(self, query: zenoh.Query, at: float) -> None:
        """Starts the answer to one query. `at`: when it arrived."""
        parsed = parse_key(str(query.key_expr))
        pool = self._pool(query, parsed)
        if self._is_foreign(parsed):
            pool.dismiss(query)
            return
        if not pool.admit(query) or self._is_too_wild(query, pool):
            return
        match parsed.family:
            case Family.SET | Family.COMMAND | Family.PEEK:
                self._start(self._request(query, parsed, at))
            case Family.STATUS if self._parts.has_keys(part := part_of(parsed.target)):
                self._take_keyed(query, part, parsed, at)
            case Family.STATUS:
                self._take_status(query)
            case Family.SELF:
                self._reads.answer(query, self._replies.own)
            case Family.VALUE if is_of_past(query.parameters):
                history = partial(self._replies.history, parsed, time.time_ns())
                self._reads.answer_history(query, history)
            case Family.VALUE if query.parameters.get("max_age") is not None:
                self._take_fresh(query, parsed)
            case _ if parsed.has_wildcard or parsed.family is Family.BLOCK:
                self._reads.answer_wide(query, partial(self._replies.current, parsed))
            case _:
                self._reads.answer(query, partial(self._replies.current, parsed))

    def _is_too_wild(self, query: zenoh.Query, pool: AnswerPool) -> bool:
        """Refuses a key that would hold up everything while it is matched."""
        if all(part.count("$*") <= _MOST_PARTS for part in str(query.key_expr).split("/")):
            return False
        pool.answer(query, partial(self._replies.outcome, _TOO_WILD))
        return True

    def _pool(self, query: zenoh.Query, parsed: ParsedKey) -> AnswerPool:
        return self._requests if _is_request(query, parsed) else self._reads

    def _is_foreign(self, parsed: ParsedKey) -> bool:
        """True for a write or command to a device of another gateway, or of none.

        It gets no answer, not even `busy`: the other gateway may carry it out.
        """
        is_request = parsed.family in (Family.SET, Family.COMMAND, Family.PEEK)
        return is_request and not parsed.has_wildcard and not self._index.owns(parsed.target)

    def _take_fresh(self, query: zenoh.Query, parsed: ParsedKey) -> None:
        if not parsed.has_wildcard:
            self._start(self._fresh(query, parsed))
        elif self._reads.admit_wide(query):
            task = self._start(self._fresh(query, parsed))
            task.add_done_callback(lambda _: self._reads.release_wide())

    def _take_status(self, query: zenoh.Query) -> None:
        if query.parameters.get("_time") is not None:
            self._reads.answer_history(query, partial(self._replies.writes, time.time_ns()))
        else:
            self._start(self._status(query))

    def _take_keyed(self, query: zenoh.Query, part: str, parsed: ParsedKey, at: float) -> None:
        if query.payload is not None:
            self._start(self._request(query, parsed, at))
        elif query.parameters.get("_time") is not None:
            past = partial(self._replies.past_entries, part, time.time_ns())
            self._reads.answer_history(query, past)
        elif parsed.has_wildcard:
            self._reads.answer_wide(query, partial(self._replies.entries, part))
        else:
            self._reads.answer(query, partial(self._replies.entries, part))

    async def close(self) -> None:
        """Ends the queries that wait for devices; their replies get half a second to leave."""
        self._reads.close()
        self._requests.close()
        self._replies.end()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(self._reads.drain(), self._requests.drain())

    def end(self) -> None:
        """Ends the answering threads, after the session is closed."""
        self._reads.end()
        self._requests.end()

    async def _request(self, query: zenoh.Query, parsed: ParsedKey, at: float) -> None:
        """Carries out one request, and answers it in every case."""
        result: Result = _ENDING
        key, data, by = str(query.key_expr), _data(query), sender(query, at)
        try:
            match parsed.family:
                case Family.SET:
                    result = await self._writes.write(key, data, by)
                case Family.COMMAND:
                    result = await self._commands.execute(key, data, by)
                case Family.PEEK:
                    result = await self._peek(query, parsed)
                case _:
                    part = part_of(parsed.target)
                    result = await self._orders.execute(part, key, data or b"", by)
        finally:
            pool = self._pool(query, parsed)
            pool.answer(query, partial(self._replies.outcome, result))

    async def _peek(self, query: zenoh.Query, parsed: ParsedKey) -> Peeked | Failure:
        device = parsed.target.rpartition("/")[2]
        longest = ANSWER_WITHIN + self._plant.dialling(device)
        try:
            check_encoding(encoding_of(query))
            text = (_data(query) or b"").decode(errors="replace")[:_LONGEST_RANGE]
            async with asyncio.timeout(longest):
                return await self._plant.peek(device, text)
        except TimeoutError:
            return Failure(Problem.BUSY, f"not read within {longest:g} s")
        except BadValue as error:
            return Failure(Problem.BAD_QUERY, str(error))
        except GatewayError as error:
            return payload.failure(error)

    async def _status(self, query: zenoh.Query) -> None:
        documents: dict[str, bytes] = {}
        try:
            documents = await self._documents()
        finally:
            self._reads.answer(query, partial(self._replies.status, documents))

    async def _fresh(self, query: zenoh.Query, parsed: ParsedKey) -> None:
        answer: Answer = partial(self._replies.outcome, _ENDING)
        try:
            tags = self._index.tags_at(parsed.target)
            unread = await self._read(tags, query.parameters.get("max_age") or "")
            answer = partial(self._replies.fresh, tags, unread)
        except BadValue as error:
            answer = partial(self._replies.outcome, Failure(Problem.BAD_QUERY, str(error)))
        finally:
            self._reads.answer(query, answer)

    async def _read(self, tags: Sequence[Tag], age_text: str) -> list[Tag]:
        """Reads the tags that are too old or become so meanwhile, each once at most.

        Returns those that could not be read in time.
        """
        unread = list[Tag]()
        if not tags:
            return unread  # another gateway's
        age = max_age(age_text)
        if len(tags) > FRESH_LIMIT:
            raise BadValue(f"{len(tags)} tags are meant; max_age reads at most {FRESH_LIMIT}")
        dialling = max(self._plant.dialling(tag.device) for tag in tags)
        until = asyncio.get_running_loop().time() + ANSWER_WITHIN + dialling
        left = dict.fromkeys(tags)
        while old := [tag for tag in left if not self._plant.is_fresh(tag, age)]:
            for tag in old:
                del left[tag]
            read = await asyncio.gather(*(self._read_one(tag, age, until) for tag in old))
            unread += [tag for tag, was_read in zip(old, read, strict=True) if not was_read]
        return unread

    async def _read_one(self, tag: Tag, age: float, until: float) -> bool:
        try:
            async with asyncio.timeout_at(until):
                await self._plant.fresh(tag, age)
        except (Busy, TimeoutError):
            return False
        return True

    def _start(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()):
            log.error("query crashed", exc_info=error)


def _is_request(query: zenoh.Query, parsed: ParsedKey) -> bool:
    """True for a write, a command, and an order to a part."""
    if parsed.family is Family.STATUS:
        return query.payload is not None and part_of(parsed.target) != ""
    return parsed.family in (Family.SET, Family.COMMAND)


def _data(query: zenoh.Query) -> bytes | None:
    return None if query.payload is None else query.payload.to_bytes()
