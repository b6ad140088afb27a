"""The one thread that puts on Zenoh, fed by a map that holds only the last value of each tag.

A put can block for as long as the network is congested, so the event loop never does one. What
waits is bounded by the number of tags: a newer value replaces one that has not gone out yet.
Every entry is stamped when it is queued and leaves in that order, for Zenoh's
AdvancedSubscriber discards whatever carries an older stamp than what it has seen of us.

Keys are not declared to Zenoh. A put on a plain key is matched against all that is declared beside
it (of this thread alone: 13 µs with 100 devices, 80 µs with 1,000), and one on a declared key is
not (2 µs). But with 50,000 of them the session takes 14 s to close, questions take three times as
long, and for a moment after a link has returned what is put on them goes nowhere, so that a
consumer that has just caught up misses it.
"""

import asyncio
import threading
from collections.abc import Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import count

import structlog
import zenoh

from gateway.northbound import forms, payload
from gateway.northbound.keys import Keys
from gateway.tags import Sample, Tag

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

EVENTS_LIMIT = 10_000  # waiting puts that must all go out


@dataclass(slots=True)
class Published:
    """Counters since the start."""

    published: int = 0  # handed to Zenoh
    superseded: int = 0  # replaced by a newer value before they went out
    dropped: int = 0  # events and documents for which there was no room, or no session yet


# What goes out on one key. A bool is its liveliness token, a dict the samples of a block. A plain
# tuple, for making a named one takes as long as queueing it.
_Entry = tuple[zenoh.Timestamp | None, str, Sample | bytes | bool | dict[str, Sample]]


class Publisher:
    """The queue (event loop) and the thread that empties it."""

    def __init__(self, keys: Keys) -> None:
        self.counters = Published()
        self.ended = asyncio.Event()  # the thread is gone, expected or not
        self._keys = keys
        self._alive: dict[str, bool] = {}  # as last said, by device
        self._session: zenoh.Session | None = None
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._waiting: dict[Hashable, _Entry] = {}
        self._serial = count()
        self._value_keys: dict[Tag, str] = {}  # making one takes as long as queueing it
        self._events = 0
        self._closing = False
        self._filled = threading.Condition()
        self._thread: threading.Thread | None = None

    # -- event loop --

    def start(self, session: zenoh.Session) -> None:
        self._session = session
        self._loop = asyncio.get_running_loop()
        for device, alive in self._alive.items():
            self.alive(device, alive)
        self._thread = threading.Thread(
            target=self._run, args=(session,), name="zenoh publisher", daemon=True
        )
        self._thread.start()

    def values(self, samples: Iterable[Sample]) -> None:
        """To be published unless a newer sample of the same tag comes first.

        Before the session is open nothing is kept: opening publishes all current values.
        """
        if self._session is None or self._closing:
            return
        stamp = self._session.new_timestamp
        with self._filled:
            for sample in samples:
                key = self._value_keys.get(sample.tag) or self._value_key(sample.tag)
                # Taken out first, so that it goes to the end: stamps leave in order.
                if self._waiting.pop(key, None) is not None:
                    self.counters.superseded += 1
                self._waiting[key] = (stamp(), key, sample)
            self._filled.notify()

    def _value_key(self, tag: Tag) -> str:
        key = self._value_keys[tag] = self._keys.value(tag.key)
        return key

    def block(self, device: str, samples: Sequence[Sample]) -> None:
        """All that changed in one scan of a device; merged with a block that still waits."""
        if self._session is None or self._closing:
            return
        key = self._keys.block(device)
        with self._filled:
            older = self._waiting.pop(key, None)
            merged = dict(older[2]) if older and isinstance(older[2], dict) else {}
            merged |= {sample.tag.name: sample for sample in samples}
            self._waiting[key] = (self._session.new_timestamp(), key, merged)
            self._filled.notify()

    def events(self, samples: Iterable[Sample]) -> None:
        """Samples that must all go out, in order (bar codes). Beyond the limit they are dropped."""
        for sample in samples:
            self._event(self._keys.value(sample.tag.key), sample)

    def document(self, key: str, document: bytes) -> None:
        """A status document or the outcome of a write, in order with everything else."""
        self._event(key, document)

    def alive(self, device: str, alive: bool) -> None:
        """Shows or takes back the device's liveliness token."""
        self._alive[device] = alive
        if self._session is None:
            return
        key = self._keys.device(device)
        with self._filled:
            self._waiting[("alive", device)] = (None, key, alive)
            self._filled.notify()

    def _event(self, key: str, what: Sample | bytes) -> None:
        with self._filled:
            if self._session is None or self._closing or self._events >= EVENTS_LIMIT:
                self.counters.dropped += 1
                return
            self._events += 1
            self._waiting[next(self._serial)] = (self._session.new_timestamp(), key, what)
            self._filled.notify()

    # -- any thread --

    def stop(self, within: float) -> None:
        """Lets what waits go out for `within` seconds, then ends the thread."""
        with self._filled:
            self._closing = True
            self._filled.notify()
        if self._thread is not None:
            self._thread.join(within)

    # -- the publishing thread --

    def _run(self, session: zenoh.Session) -> None:
        try:
            self._empty(session)
        finally:
            with suppress(RuntimeError):  # the loop is closed already
                self._loop.call_soon_threadsafe(self.ended.set)

    def _empty(self, session: zenoh.Session) -> None:
        while batch := self._next_batch():
            while batch:
                stamp, key, what = batch.pop()
                try:
                    self._send(session, stamp, key, what)
                except zenoh.ZError as error:
                    if session.is_closed():
                        return
                    log.warning("not published", key=key, error=str(error))

    def _next_batch(self) -> list[_Entry]:
        """All that waits, the first last; empty only when the publisher is to end.

        A list, to be let go of one by one: 50,000 entries at once hold up the loop for 5 ms.
        """
        with self._filled:
            while not self._waiting and not self._closing:
                self._filled.wait()
            waiting, self._waiting = self._waiting, {}
            self._events = 0
        batch = list(waiting.values())
        batch.reverse()
        return batch

    def _send(
        self,
        session: zenoh.Session,
        stamp: zenoh.Timestamp | None,
        key: str,
        what: Sample | bytes | bool | dict[str, Sample],
    ) -> None:
        if isinstance(what, Sample):
            forms.put(session, key, what, stamp)
        elif isinstance(what, bytes):
            forms.put_json(session, key, what, stamp)
        elif isinstance(what, dict):
            forms.put_json(session, key, payload.block(what.values()), stamp)
        else:
            self._token(session, key, declared=what)
            return
        self.counters.published += 1

    def _token(self, session: zenoh.Session, key: str, *, declared: bool) -> None:
        if not declared:
            if token := self._tokens.pop(key, None):
                token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        elif key not in self._tokens:
            self._tokens[key] = session.liveliness().declare_token(key)
