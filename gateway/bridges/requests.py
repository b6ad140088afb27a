"""Queries and writes of a bridge, and what arrives by itself: the crossings to Zenoh's threads."""

import asyncio
import json
import os
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import orjson
import zenoh

from gateway.bridges.documents import Known, copied, utc_now
from gateway.contract.access.signatures import sign

ANSWER_WITHIN = 10.0  # seconds: a gateway answers within eight, also a write
MOST_WAITING = 200_000  # samples between Zenoh's threads and the event loop
Receive = Callable[[str, bool, bytes, bytes], None]  # key, put or delete, payload, attachment


class Requests:
    """Asks the gateways below a prefix. `WRITER`: `name:secret`, as docs/security.md has it."""

    WRITER = "PLC_GATEWAY_WRITER"

    def __init__(self, session: zenoh.Session, prefix: str) -> None:
        self._session, self._prefix = session, prefix
        self._loop = asyncio.get_running_loop()

    async def ask(self, selector: str, **options: Any) -> list[zenoh.Reply]:
        """Returns all replies to a query."""
        replies: list[zenoh.Reply] = []
        ended = asyncio.Event()

        def end() -> None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(ended.set)

        handler = zenoh.handlers.Callback(replies.append, end, indirect=False)
        options = {
            "timeout": ANSWER_WITHIN,
            "consolidation": zenoh.ConsolidationMode.NONE,
        } | options
        get = partial(self._session.get, f"{self._prefix}/{selector}", handler, **options)
        await asyncio.to_thread(get)
        await ended.wait()
        return replies

    async def write(
        self, key: str, value: object, time: str | None = None, writer: str | None = None
    ) -> Known:
        """Writes once. Returns `outcome`: `written`, or an error of docs/zenoh.md with `reason`.

        `time`: when the write was ordered; the gateway refuses it five seconds later. `writer`:
        `name:secret` of the one who writes, where the environment names none.
        """
        if all(reply.ok is None for reply in await self.ask(f"{key}/@meta")):
            why = "no gateway serves this tag now: nothing was sent"
            return {"outcome": "no-gateway", "reason": why}
        payload = json.dumps(value).encode()  # not orjson: a float tag accepts any integer
        return {"outcome": "written"} | await self.order(f"{key}/@set", payload, time, writer)

    async def order(
        self, key: str, payload: bytes, time: str | None = None, writer: str | None = None
    ) -> Known:
        """Sends a query with a payload once. Returns the answer, or `outcome` as `write`."""
        attachment = orjson.dumps({"time": time}) if time else None
        if writer := os.environ.get(self.WRITER) or writer:
            name, _, secret = writer.partition(":")
            whole_key = f"{self._prefix}/{key}"
            attachment = sign(name, secret, time or utc_now(), whole_key, payload)
        for reply in await self.ask(key, payload=payload, attachment=attachment):
            with suppress(ValueError, TypeError, KeyError):  # of another program
                if reply.ok is not None:
                    return dict(orjson.loads(reply.ok.payload.to_bytes()))
                failed = reply.err
                if failed and failed.encoding == zenoh.Encoding.APPLICATION_JSON:
                    known = dict(orjson.loads(failed.payload.to_bytes()))
                    return {"outcome": str(known.pop("error")), **known}
        return {"outcome": "unclear", "reason": "no answer: it may or may not have been done"}


class Inbox:
    """Brings samples to the event loop, in their order. `overrun` is called there after a loss."""

    def __init__(self, overrun: Callable[[], None]) -> None:
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[Receive, tuple[str, bool, bytes, bytes]]] = deque()
        self._woken = self._has_lost = False
        self._overrun = overrun

    def callback(self, receive: Receive, *, always: bool = False) -> Callable[[zenoh.Sample], None]:
        """Returns the callback of a subscriber. `always`: none of its samples may be lost."""

        def callback(sample: zenoh.Sample) -> None:
            if len(self._waiting) >= MOST_WAITING and not always:
                self._has_lost = True
                return
            self._waiting.append((receive, copied(sample)))
            if not self._woken:
                self._woken = True
                with suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._drain)

        return callback

    def _drain(self) -> None:
        self._woken = False  # first, so that no sample is left waiting
        while self._waiting:
            receive, sample = self._waiting.popleft()
            receive(*sample)
        if self._has_lost:
            self._has_lost = False
            self._overrun()
