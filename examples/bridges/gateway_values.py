"""The values of a plant from Zenoh, and its writes: shared by the bridges in this folder.

A value is good only while a gateway says so and the liveliness token of its device exists. When the
token goes, the values of the device turn bad here, because no gateway can say it any more. They
turn good again by values that arrive after the token has returned, never by older ones.
"""

import asyncio
import hashlib
import hmac
import json
import os
import secrets
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

import zenoh
from program import say

QUERY_EVERY = 60.0  # seconds between two queries of all values without a known reason
RETRY_AFTER = 0.5  # seconds, doubled up to QUERY_EVERY while values are missing
SETTLE = 0.1  # seconds
ANSWER_WITHIN = 10.0  # seconds: a gateway answers within eight, also a write
MOST_WAITING = 200_000  # samples between Zenoh's threads and the event loop

Known = dict[str, Any]  # value, quality, time, and the reason of a bad value: docs/zenoh.md


def utc_now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def bad(reason: str) -> Known:
    return {"value": None, "quality": "bad", "reason": reason, "time": utc_now()}


def is_value(known: Any) -> bool:
    """Checks a document. Raises KeyError, TypeError or ValueError where a field lacks."""
    value, reason = known["value"], known.get("reason")
    if datetime.fromisoformat(known["time"]).tzinfo is None:
        return False
    if known["quality"] == "bad":
        return value is None and isinstance(reason, str)
    if known["quality"] != "good" and not (known["quality"] == "uncertain" and reason):
        return False
    if isinstance(value, list):  # of an array
        return all(map(is_number, value))
    return is_number(value) or isinstance(value, str)


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max  # no NaN


class Plant:
    """All tags under a prefix. Keys are `device/tag`.

    Calls in the event loop `described(key, meta)` for every new or changed description, and then
    `changed(key, known)` for every new value.
    """

    def __init__(
        self,
        session: zenoh.Session,
        prefix: str,
        described: Callable[[str, Known], None],
        changed: Callable[[str, Known], None],
    ) -> None:
        self.tags: dict[str, Known] = {}
        self.values: dict[str, Known] = {}
        self._session, self._prefix = session, prefix
        self._writer = os.environ.get("PLC_GATEWAY_WRITER", "")  # `name:secret`: docs/security.md
        self._described, self._changed = described, changed
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[tuple[Callable[..., None], Any]] = deque()
        self._woken = self._overrun = False
        self._query_due, self._arrived = asyncio.Event(), asyncio.Event()
        self._gateways: set[str] = set()
        self._alive: dict[str, set[str]] = {}  # device: the gateways that report it as answering
        self._served_by: dict[str, str] = {}  # device: the last of them
        self._asked: set[str] = set()  # devices whose descriptions are being read
        self._trusted: set[str] = set()  # devices that answer, described since they do
        self._live: set[str] = set()  # keys that changed after the last query began
        live, own = session.liveliness(), f"{prefix}/@gateway/*"
        self._declared = [
            session.declare_subscriber(f"{prefix}/**", self._hop(self._sample)),
            session.declare_subscriber(f"{prefix}/*/@block", self._hop(self._block)),
            live.declare_subscriber(own, self._hop(self._token), history=True),
            live.declare_subscriber(f"{own}/alive/*", self._hop(self._token), history=True),
        ]

    # -- Zenoh's threads --

    def _hop(self, receive: Callable[..., None]) -> Callable[[zenoh.Sample], None]:
        """Returns a callback that gives a copy of each sample to the event loop, in order."""

        def callback(sample: zenoh.Sample) -> None:
            if len(self._waiting) >= MOST_WAITING and receive != self._token:
                self._overrun = True  # a query follows instead of this value
                return
            self._waiting.append((receive, copied(sample)))
            if not self._woken:
                self._woken = True
                self._call(self._drain)

        return callback

    def _call(self, function: Callable[[], None]) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function)

    # -- the event loop --

    def _drain(self) -> None:
        self._woken = False  # first, so that no sample is left waiting
        while self._waiting:
            receive, sample = self._waiting.popleft()
            receive(*sample)
        if self._overrun:
            self._overrun = False
            self._query_due.set()

    def key(self, key: str) -> str:
        return key.removeprefix(f"{self._prefix}/")

    def _token(self, key: str, there: bool, *_rest: object) -> None:
        gateway, _, device = self.key(key).removeprefix("@gateway/").partition("/alive/")
        if device and there:
            self._alive.setdefault(device, set()).add(gateway)
            self._served_by[device] = gateway
            self._asked.discard(device)
        elif device:
            self._gone(gateway, device, "no-reply")  # the gateway tells the exact reason
        elif there:
            self._gateways.add(gateway)
            say(f"gateway {gateway} is there")
        else:
            self._gateways.discard(gateway)
            say(f"gateway {gateway} is gone")
            for lost in {key.partition("/")[0] for key in self.tags}:
                if self._served_by.get(lost, gateway) == gateway:
                    self._gone(gateway, lost, "no-gateway")
        self._query_due.set()
        if there:
            self._arrived.set()

    def _gone(self, gateway: str, device: str, reason: str) -> None:
        alive = self._alive.get(device, set())
        alive.discard(gateway)
        if alive:
            return
        self._asked.discard(device)
        self._trusted.discard(device)
        for key, known in list(self.values.items()):
            of_device = key.startswith(f"{device}/")
            if of_device and (known["quality"] != "bad" or reason == "no-gateway"):
                self._store(key, bad(reason))

    def _sample(self, key: str, is_put: bool, payload: bytes, about: bytes) -> None:
        key = self.key(key)
        if known := self.read(key, is_put, payload, about):
            self._live.add(key)
            self._take(key, known)

    def _block(self, key: str, is_put: bool, payload: bytes, _about: bytes) -> None:
        device = self.key(key).removesuffix("/@block")
        with suppress(ValueError, AttributeError):
            for tag, document in json.loads(payload).items():
                self._sample(f"{device}/{tag}", is_put, json.dumps(document).encode(), b"")

    def read(self, key: str, is_put: bool, payload: bytes, about: bytes) -> Known | None:
        """Reads a payload, also of a tag with `payload: raw`. None: no gateway has the tag."""
        if (tag := self.tags.get(key)) is None:
            return None
        try:
            if not about:
                known = json.loads(payload)
            else:
                text = payload.decode()
                value = text if tag["type"].startswith("string") else json.loads(text or "null")
                known = {"value": value if is_put else None, **json.loads(about)}
            return known if is_value(known) else bad("garbled")
        except (KeyError, TypeError, ValueError):
            return bad("garbled")  # from another program

    def _take(self, key: str, known: Known) -> None:
        # Without a token it may be from before the token went, or belong to a new description.
        if known["quality"] == "bad" or key.partition("/")[0] in self._trusted:
            self._store(key, known)

    def _store(self, key: str, known: Known) -> None:
        if known != self.values.get(key):
            self.values[key] = known
            self._changed(key, known)

    async def follow(self) -> None:
        """Queries all tags and values after every change of gateways or devices, and regularly."""
        pause, may_hang = RETRY_AFTER, True
        while True:
            self._query_due.clear()
            self._arrived.clear()
            query = asyncio.create_task(self._query())
            arrived = asyncio.create_task(self._arrived.wait())
            # A query that was sent when the link went would wait for its time-out.
            waited = {query, arrived} if may_hang else {query}
            await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
            arrived.cancel()
            may_hang = query.done()
            if not query.done():
                query.cancel()
                await asyncio.sleep(SETTLE)  # gateways and devices arrive together
                continue
            pause = QUERY_EVERY if query.result() else min(2 * pause, QUERY_EVERY)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._query_due.wait(), pause)
                pause = RETRY_AFTER

    async def _query(self) -> bool:
        """Returns True if every tag of every device with a token was answered."""
        self._asked = {device for device, gateways in self._alive.items() if gateways}
        described = set()
        for reply in await self.ask("**/@meta"):
            if (sample := reply.ok) is not None:
                key = self.key(str(sample.key_expr)).removesuffix("/@meta")
                meta = json.loads(sample.payload.to_bytes())
                described.add(key.partition("/")[0])
                if self.tags.get(key) != meta:
                    self.tags[key] = meta
                    self._described(key, meta)
                    if key not in self.values:
                        self._store(key, bad("starting"))
        self._trusted |= self._asked & described
        self._live.clear()
        replies = [reply.ok for reply in await self.ask("**")]
        answered = {self.key(str(sample.key_expr)) for sample in replies if sample is not None}
        for sample in replies:
            key = "" if sample is None else self.key(str(sample.key_expr))
            # A value that arrived by itself meanwhile may be newer.
            if sample and key not in self._live and (known := self.read(key, *copied(sample)[1:])):
                self._take(key, self._not_again(key, known))
        if None in replies or not answered:
            return not self._gateways
        gone = self.values.keys() - answered - self._live
        for key in gone:
            if self.values[key]["quality"] != "bad":
                self._store(key, bad("no-gateway"))
        alive = {device for device, gateways in self._alive.items() if gateways}
        return alive <= self._trusted and all(
            key in answered for key in self.tags if key.partition("/")[0] in alive
        )

    def _not_again(self, key: str, known: Known) -> Known:
        """An event (a bar code) is passed on when it happens, and never from a query."""
        before = self.values[key]
        if known["quality"] == "bad" or not self.tags[key].get("event"):
            return known
        is_waiting = before["quality"] != "bad" or before["reason"] == "starting"
        return before if is_waiting else bad("starting")

    async def ask(self, selector: str, **options: Any) -> list[zenoh.Reply]:
        """Returns all replies to a query."""
        replies: list[zenoh.Reply] = []
        ended = asyncio.Event()
        handler = zenoh.handlers.Callback(
            replies.append, lambda: self._call(ended.set), indirect=False
        )
        options = {
            "timeout": ANSWER_WITHIN,
            "consolidation": zenoh.ConsolidationMode.NONE,
        } | options
        await asyncio.to_thread(self._session.get, f"{self._prefix}/{selector}", handler, **options)
        await ended.wait()
        return replies

    async def write(self, key: str, value: object, time: str | None = None) -> Known:
        """Writes once. Returns `outcome`: `written`, or an error of docs/zenoh.md with `reason`.

        `time`: when the write was ordered; the gateway refuses it five seconds later.
        """
        described = key in self.tags and await self.ask(f"{key}/@meta")
        if not described or all(reply.ok is None for reply in described):
            why = "no gateway serves this tag now: nothing was sent"
            return {"outcome": "no-gateway", "reason": why}
        payload = json.dumps(value)
        about = {"time": time} if time else {}
        if self._writer:
            about = sign(self._writer, time or utc_now(), f"{self._prefix}/{key}/@set", payload)
        attachment = json.dumps(about) if about else None
        for reply in await self.ask(f"{key}/@set", payload=payload, attachment=attachment):
            if reply.ok is not None:
                return {"outcome": "written", **json.loads(reply.ok.payload.to_bytes())}
            if reply.err.encoding == zenoh.Encoding.APPLICATION_JSON:  # else from Zenoh: no reply
                failed = json.loads(reply.err.payload.to_bytes())
                return {"outcome": failed.pop("error"), **failed}
        return {"outcome": "unclear", "reason": "no answer: it may or may not have been done"}


def sign(writer: str, time: str, key: str, payload: str) -> Known:
    name, _, secret = writer.partition(":")
    nonce = secrets.token_hex(16)
    text = f"{name}\n{time}\n{nonce}\n{key}\n{payload}"
    signature = hmac.new(secret.encode(), text.encode(), hashlib.sha256).hexdigest()
    return {"by": name, "time": time, "nonce": nonce, "signature": signature}


def copied(sample: zenoh.Sample) -> tuple[str, bool, bytes, bytes]:
    """Returns key, put or delete, payload, attachment. (A sample keeps the batch it came in.)"""
    about = sample.attachment
    is_put = sample.kind == zenoh.SampleKind.PUT
    return (
        str(sample.key_expr),
        is_put,
        sample.payload.to_bytes(),
        b"" if about is None else about.to_bytes(),
    )
