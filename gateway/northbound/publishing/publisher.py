"""The one thread that puts on Zenoh, fed by a map that holds only the last value of each tag.

Alarms and outcomes of writes are urgent: they go before all that waits, here and on each link.

A put can block for as long as the network is congested, so the event loop never does one. The
queue is bounded by the number of tags: a newer value replaces one that is still waiting.
Every entry gets its time stamp when it is queued and leaves in that order, because Zenoh's
AdvancedSubscriber discards a sample with an older stamp than the last one of the same session.

Keys are not declared to Zenoh. A put on a plain key is compared with every declaration beside it,
level by level, so nothing is declared for a single device there (keys.py). A put on a declared key
is not compared. But with 50,000 declared keys the session takes 14 s to close, queries take three
times as long, and for a moment after a link has returned puts on declared keys reach no subscriber.
"""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from contextlib import suppress

import structlog
import zenoh

from gateway.contract import payload
from gateway.contract.blocks import parts_of
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing import encoding
from gateway.northbound.publishing.handover import Handover
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.tags import Sample
from gateway.tags.scan import Samples

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

MOST_SHOWN = 10  # keys
EVENTS_LIMIT = 10_000  # waiting puts that no newer one may replace

# The JSON of a value or document is bytes, a bool declares or undeclares the liveliness token, a
# dict holds the samples of a block, and a function makes an urgent document.
_Data = bytes | Sample | bool | dict[str, Sample] | Callable[[], bytes]
# One put. A plain tuple: creating a named tuple takes as long as queueing it.
_Entry = tuple[zenoh.Timestamp | None, str, _Data]


class _Sender:
    """Sends one entry at a time. Belongs to the publishing thread."""

    def __init__(self) -> None:
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._blocks = Counter[str]()  # sent since the start, by key

    def send(
        self,
        session: zenoh.Session,
        stamp: zenoh.Timestamp | None,
        key: str,
        data: Sample | bool | dict[str, Sample] | Callable[[], bytes],
    ) -> bool:
        """Returns True if it was a put."""
        if isinstance(data, Sample):
            encoding.put(session, key, data, stamp)
        elif isinstance(data, dict):
            self._blocks[key] += 1
            place = payload.place(str(session.zid()), self._blocks[key])
            encoding.put_json(session, key, payload.block(data.values()), stamp, place)
        elif isinstance(data, bool):
            self._set_token(session, key, declared=data)
            return False
        else:
            encoding.put_json(session, key, data(), stamp, urgent=True)
        return True

    def _set_token(self, session: zenoh.Session, key: str, *, declared: bool) -> None:
        if not declared:
            if token := self._tokens.pop(key, None):
                token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        elif key not in self._tokens:
            self._tokens[key] = session.liveliness().declare_token(key)


class Publisher:
    """The queue (event loop) and the thread that empties it."""

    def __init__(self, losses: SlowPuts, index: TagIndex) -> None:
        self.ended = asyncio.Event()  # the thread has ended, expected or not
        self.superseded = Counter[str]()  # values that a newer one replaced here, by tag
        self._dropped = 0  # events and documents: the queue was full, or no session was open yet
        self._index = index
        self._losses = losses
        self._online: dict[str, bool] = {}  # by device
        self._session: zenoh.Session | None = None
        self._waiting: dict[Hashable, _Entry] = {}
        self._urgent: dict[Hashable, _Entry] = {}
        self._batch: list[_Entry] = []  # the next one at the end
        self._others = 0  # entries of the batch that urgent ones go before
        self._waiting_events = 0
        self._handover = Handover(lambda: len(self._waiting) + len(self._batch))
        self._thread: threading.Thread | None = None

    # -- event loop --

    def counts(self) -> dict[str, int]:
        """Counters since the start, by their names in the status."""
        return {
            "published": self._handover.puts,
            "superseded": self.superseded.total(),
            "dropped": self._dropped,
            "congested": self._losses.congested,
        }

    def most_superseded(self) -> dict[str, int]:
        """Returns the keys of the values that newer ones replaced most often, with how often."""
        most = self.superseded.most_common(MOST_SHOWN)
        return {self._index.keys.value(tag): count for tag, count in most}

    @property
    def session(self) -> zenoh.Session | None:
        """The open session; None before and after."""
        return None if self._handover.closing else self._session

    def start(self, session: zenoh.Session) -> None:
        self._session = session
        for device, online in self._online.items():
            self.set_online(device, online)
        self._thread = threading.Thread(
            target=self._run,
            args=(session, asyncio.get_running_loop()),
            name="zenoh publisher",
            daemon=True,
        )
        self._thread.start()

    def values(self, samples: Sequence[Sample]) -> None:
        """Queues samples; each is published unless a newer sample of its tag replaces it.

        Before the session is open samples are dropped: opening publishes all current values.
        """
        if self._session is None or self._handover.closing:
            return
        data: Sequence[_Data]
        if isinstance(samples, Samples):
            tags, data = [tag.key for tag in samples.tags], encoding.scan(samples)
        else:
            last = {sample.tag.key: sample for sample in samples}
            tags, data = [*last], [*last.values()]
            if len(last) < len(samples):
                gone = [sample.tag.key for sample in samples if last[sample.tag.key] is not sample]
                self.superseded.update(gone)
        keys = map(self._index.keys.value, tags)
        stamp, waiting = self._session.new_timestamp, self._waiting
        with self._handover.lock:
            if not waiting.keys().isdisjoint(tags):
                # Removed first, so that the entry moves to the end: stamps leave in order.
                self.superseded.update([tag for tag in tags if waiting.pop(tag, None)])
            puts = zip([stamp() for _ in tags], keys, data, strict=True)
            waiting.update(zip(tags, puts, strict=True))
        self._handover.soon()

    def block(self, device: str, samples: Sequence[Sample]) -> None:
        """Queues the changed samples of one scan of a device, merged with a waiting block.

        A long block goes out in parts: many clients drop long messages.
        """
        if self._session is None or self._handover.closing:
            return
        key = self._index.keys.block(device)
        merged: dict[str, Sample] = {}
        with self._handover.lock:
            for part in range(len(self._waiting)):
                older = self._waiting.pop((key, part), None)
                if older is None or not isinstance(older[2], dict):
                    break
                merged |= older[2]
            merged |= {sample.tag.name: sample for sample in samples}
            for part, some in enumerate(parts_of(merged)):
                self._waiting[key, part] = (self._session.new_timestamp(), key, some)
        self._handover.soon()

    def events(self, samples: Iterable[Sample]) -> None:
        """Queues samples that all go out, in order (bar codes). Drops those beyond the limit."""
        for sample in samples:
            self._queue_event(self._index.keys.value(sample.tag.key), sample)

    def document(self, key: str, document: bytes) -> None:
        """Queues a status document, or the outcome of a write, which is urgent."""
        self._queue_event(key, (lambda: document) if key == self._index.keys.writes else document)

    def latest(self, key: str, make: Callable[[], bytes]) -> None:
        """Queues an urgent document that the publishing thread makes: only the latest of each key
        is put.

        Opening a session publishes all of them.
        """
        if self._session is None or self._handover.closing:
            return
        with self._handover.lock:
            self._urgent.pop(key, None)
            self._urgent[key] = (self._session.new_timestamp(), key, make)
        self._handover.soon()

    def set_online(self, device: str, online: bool) -> None:
        """Declares or undeclares the device's liveliness token."""
        self._online[device] = online
        if self._session is None:
            return
        key = self._index.keys.alive(device)
        with self._handover.lock:
            self._waiting["token", device] = (None, key, online)
        self._handover.soon()

    def forget(self, devices: Iterable[str]) -> None:
        """Forgets devices that the gateway no longer has. Their tokens end first."""
        for device in devices:
            self._online.pop(device, None)

    def _queue_event(self, key: str, data: Sample | bytes | Callable[[], bytes]) -> None:
        urgent = key == self._index.keys.writes
        with self._handover.lock:
            waiting = len(self._urgent) if urgent else self._waiting_events
            if self._session is None or self._handover.closing or waiting >= EVENTS_LIMIT:
                self._dropped += 1
                return
            self._waiting_events += not urgent
            queue = self._urgent if urgent else self._waiting
            queue[object()] = (self._session.new_timestamp(), key, data)
        self._handover.soon()

    # -- any thread --

    def stop(self, within: float) -> None:
        """Ends the thread once the queue is empty; waits at most `within` seconds for that."""
        with self._handover.lock:
            self._handover.closing = True
            self._handover.let_run()
        if self._thread is not None:
            self._thread.join(within)

    # -- the publishing thread --

    def _run(self, session: zenoh.Session, loop: asyncio.AbstractEventLoop) -> None:
        try:
            self._send_all(session)
        finally:
            with suppress(RuntimeError):  # the loop is closed already
                loop.call_soon_threadsafe(self.ended.set)

    def _send_all(self, session: zenoh.Session) -> None:
        handover, losses, monotonic = self._handover, self._losses, time.monotonic
        sender = _Sender()
        while self._next_batch():
            batch, before = self._batch, monotonic()
            while batch:
                stamp, key, data = batch.pop()
                try:
                    if isinstance(data, bytes):
                        encoding.put_json(session, key, data, stamp)
                        handover.puts += 1
                    else:
                        handover.puts += sender.send(session, stamp, key, data)
                except zenoh.ZError as error:
                    if session.is_closed():
                        return
                    log.warning("Zenoh put failed", key=key, error=str(error))
                now = monotonic()
                if now - before >= losses.limit or now < losses.until:
                    losses.sent(self._values_of(key, data), now - before, now)
                if now >= handover.until:
                    handover.give_back()
                    now = monotonic()
                before = now
                if self._urgent and len(batch) <= self._others:  # the outcomes keep their order
                    self._next_batch()
                    before = monotonic()

    def _next_batch(self) -> bool:
        """Takes all urgent entries, or else all others that wait. False: the publisher ends.

        The caller frees the entries one by one: freeing 50,000 at once holds up the loop for 5 ms.
        """
        with self._handover.lock:
            while not (self._waiting or self._urgent or self._handover.closing):
                self._handover.rest()
            if self._urgent:
                waiting, self._urgent, self._others = self._urgent, {}, len(self._batch)
            else:
                waiting, self._waiting, self._others = self._waiting, {}, len(self._waiting)
                self._waiting_events = 0
            self._batch += reversed(waiting.values())
            return bool(waiting)

    def _values_of(self, key: str, data: _Data) -> Sequence[str]:
        """Returns the keys of the values in a put."""
        if isinstance(data, dict):
            return [self._index.keys.value(sample.tag.key) for sample in data.values()]
        return [key]
