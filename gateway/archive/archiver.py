"""Follows the histories of all gateways below a prefix, and stores each sample once.

A gateway keeps its samples; nothing waits here. While the network or the store is down, the cursors
stay where they are, and the pages after them are read later.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import zenoh

from gateway.archive.pages import History, Page, file_of
from gateway.archive.rows import Row, rfc3339
from gateway.archive.store import Cursor, Gap, Overtaken, Store, StoreDown
from gateway.archive.stores import store_at
from gateway.archive.turn import Turn, group_of
from gateway.bridges.program import Gateways, opened, say
from gateway.errors import GatewayError

PAGE = 10_000  # samples
PAGES = 8  # under way at once
RETRY, LONGEST_PAUSE = 1.0, 30.0  # seconds
MOST_GATEWAYS = 10_000
NOTE_EVERY = 60.0  # seconds: a gateway without new samples is noted as whole
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Pace:
    """`every`: seconds between two looks at a gateway. `rate`: samples a second of each."""

    every: float
    rate: int


@dataclass(eq=False)
class Follower:
    """Archives one gateway. `add`: of the store."""

    history: History
    cursor: Cursor
    add: Callable[[Sequence[Row], Cursor, Cursor], Awaitable[Cursor]]
    pace: Pace
    pages: asyncio.Semaphore
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    _trouble: str | None = None

    async def run(self) -> None:
        """Until it is cancelled. Raises `Overtaken`."""
        pause = RETRY
        while True:
            self.wake.clear()
            started = time.monotonic()
            try:
                async with self.pages:
                    page = await self.history.page(self.cursor.after, min(PAGE, self.pace.rate))
                    await self._store(page)
            except Overtaken:
                raise
            except GatewayError as error:
                if not isinstance(error, StoreDown):  # the same for all gateways
                    self._say(str(error))
                wait, pause = pause, min(2 * pause, LONGEST_PAUSE)
            else:
                self._say(None)
                pause, took = RETRY, time.monotonic() - started
                # At the end it looks again after a while; before, as fast as it may.
                due = self.pace.every if page.is_last else len(page.rows) / self.pace.rate
                wait = max(0.0, due - took)
            with suppress(TimeoutError):
                async with asyncio.timeout(wait):
                    await self.wake.wait()

    async def _store(self, page: Page) -> None:
        before, now = self.cursor, time.time_ns() // 1000
        is_other = file_of(before.after) not in ("", page.file)
        may_overlap = before.overlaps or is_other or page.lost is not None
        after = replace(before, after=page.next, overlaps=may_overlap)
        for why in self._gaps(page, is_other=is_other):
            first = min((row.time for row in page.rows), default=None)
            gap = Gap(
                rfc3339(before.newest) if before.newest else None,
                None if first is None else rfc3339(first),
                why,
            )
            after = after.with_gap(gap)
            say(f"{before.gateway}: {why}; between {gap.begin} and {gap.end}")
        if page.is_last:
            after = replace(after, whole=now)
        # Not what a clock that was ahead has noted: it would count until then.
        is_noted = 0 <= now - before.whole < NOTE_EVERY * 1e6 or not page.is_last
        if is_noted and not page.rows and (before.after, before.gaps) == (after.after, after.gaps):
            return
        stored = await self.add(page.rows, before, after)
        # All that was in the file is stored, so the next pages have only new samples.
        self.cursor = replace(stored, overlaps=stored.overlaps and not page.is_whole)

    def _gaps(self, page: Page, *, is_other: bool) -> list[str]:
        found = [page.lost] if page.lost else []
        if is_other:
            found.append("its history is another file: samples may be missing")
        if page.strange:
            found.append(f"{page.strange} samples cannot be read")
        return found

    def _say(self, trouble: str | None) -> None:
        if trouble != self._trouble:
            say(f"{self.cursor.gateway}: {trouble or 'archiving goes on'}")
        self._trouble = trouble


class Archiver:
    """Follows every gateway that it sees."""

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        store: Store,
        pace: Pace,
        thread: ThreadPoolExecutor,
    ) -> None:
        self._session, self._store, self._pace, self._thread = session, store, pace, thread
        self._gateways: set[str] = set()
        self._arrived = asyncio.Event()
        self._followers: dict[str, Follower] = {}
        self._trouble: str | None = None  # of the store
        loop = asyncio.get_running_loop()

        def changed(token: zenoh.Sample) -> None:
            if token.kind == zenoh.SampleKind.PUT:
                with suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(self._is_there, str(token.key_expr))

        self._subscriber = session.liveliness().declare_subscriber(
            f"{prefix}/@gateway/*", zenoh.handlers.Callback(changed, indirect=False), history=True
        )

    def _is_there(self, gateway: str) -> None:
        if gateway in self._gateways:
            if gateway in self._followers:
                self._followers[gateway].wake.set()
        elif len(self._gateways) < MOST_GATEWAYS:
            self._gateways.add(gateway)
            self._arrived.set()
        else:
            say(f"{gateway} is not archived: there are {MOST_GATEWAYS} gateways already")

    async def work(self) -> None:
        """Archives until it is cancelled."""
        while True:
            cursors = await self._cursors()
            try:
                async with asyncio.TaskGroup() as group:
                    await self._follow(group, cursors)
            except* Overtaken as overtaken:
                say(f"{overtaken.exceptions[0]}: its cursors are read again")
                await asyncio.sleep(RETRY)
            finally:
                self._followers.clear()

    async def _follow(self, group: asyncio.TaskGroup, cursors: Mapping[str, Cursor]) -> None:
        pages = asyncio.Semaphore(PAGES)
        add = partial(self._stored, self._store.add)
        while True:
            self._arrived.clear()
            for gateway in sorted(self._gateways - self._followers.keys()):
                cursor = cursors.get(gateway, Cursor(gateway))
                history = History(self._session, gateway)
                follower = Follower(history, cursor, add, self._pace, pages)
                self._followers[gateway] = follower
                group.create_task(follower.run())
                say(f"{gateway}: archived after {cursor.after or 'the beginning'}")
            await self._arrived.wait()

    async def _cursors(self) -> Mapping[str, Cursor]:
        pause = RETRY
        while True:
            try:
                return await self._stored(self._store.cursors)
            except StoreDown:
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)

    async def _stored(self, call: Callable[..., T], *arguments: object) -> T:
        """Calls the store in its thread. A call that has begun ends there in any case."""
        loop, trouble = asyncio.get_running_loop(), None
        try:
            return await loop.run_in_executor(self._thread, call, *arguments)
        except StoreDown as error:
            trouble = str(error)
            raise
        finally:
            if trouble != self._trouble:
                say(f"the store is not ready: {trouble}" if trouble else "the store is ready")
            self._trouble = trouble


async def archive(gateways: Gateways, place: str, every: float | None, rate: int) -> None:
    """Serves until it is cancelled."""
    store = store_at(place)
    pace = Pace(store.every if every is None else every, rate)
    thread = ThreadPoolExecutor(1, "store")
    try:
        with await opened(gateways) as session:
            archiver = Archiver(session, gateways.prefix, store, pace, thread)
            await Turn(session, gateways.prefix, group_of(place)).run(archiver.work)
    finally:
        thread.shutdown(cancel_futures=True)
        store.close()
