"""The one thread that puts on Zenoh, fed by a map that holds only the last value of each tag.

Alarms and outcomes of writes are urgent: they go before all that waits, here and on each link.

A put can block for as long as the network is congested, so the event loop never does one. The
queue is bounded by the number of tags: a newer value replaces one that is still waiting.
With many values to send the event loop pauses for the thread, `_PAUSE` at most: both need Python's
lock. Without it the thread gets the lock only while the loop waits for a system call, and sends
less the more there is to send.
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
from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import compress
from typing import NamedTuple

import structlog
import zenoh

from gateway.contract import payload
from gateway.contract.blocks import parts_of
from gateway.contract.keys import Keys
from gateway.northbound.answering.tag_index import TagIndex
from gateway.northbound.publishing import encoding
from gateway.northbound.publishing.slow_puts import SlowPuts
from gateway.tags import Reason, Sample, Tag, good
from gateway.tags.scan import Samples

log: structlog.stdlib.BoundLogger = structlog.get_logger(__name__)

EVENTS_LIMIT = 10_000  # waiting puts that no newer one may replace
_MANY = 100  # waiting values for which the loop pauses
_PAUSE = 0.005  # seconds


@dataclass(slots=True)
class Published:
    """Counters since the start."""

    published: int = 0  # handed to Zenoh
    superseded: int = 0  # replaced by a newer value before they went out
    dropped: int = 0  # events and documents: the queue was full, or no session was open yet


class _Scan(NamedTuple):
    """Values of one read of a block, each with the stamp and the key of its put."""

    stamps: Sequence[zenoh.Timestamp]
    keys: Sequence[str]
    samples: Samples

    def without(self, gone: Collection[Tag]) -> "_Scan":
        kept = [tag not in gone for tag in self.samples.tags]
        stamps, keys = compress(self.stamps, kept), compress(self.keys, kept)
        return _Scan(tuple(stamps), tuple(keys), self.samples.without(gone))


# A bool declares or undeclares the liveliness token, a dict holds the samples of a block, and a
# function makes a document.
_Data = Sample | bytes | bool | dict[str, Sample] | Callable[[], bytes]
# One put, or those of a scan. A plain tuple: creating a named tuple takes as long as queueing it.
_Entry = tuple[zenoh.Timestamp | None, str, _Data | _Scan]


class _Turns:
    """The lock of the queue, and the moments when loop and thread wait for each other."""

    def __init__(self) -> None:
        self.lock = threading.Condition()
        self.values = 0  # new ones since the loop waited
        self._emptied = threading.Event()  # the thread has sent all that waited
        self._rests = False  # the thread waits for something to send
        self._stuck = -1  # puts so far when the loop waited in vain
        self._resumed = 0.0  # when the loop waited last

    def rest(self) -> None:
        """Has the thread wait for something to send. It holds the lock."""
        self._rests = True
        self._emptied.set()
        self.lock.wait()
        self._rests = False

    def pause(self, waiting: Collection[Hashable], counters: Published) -> None:
        """Has the loop wait if many values are queued, but no more while a put is stuck."""
        if self.values < _MANY or counters.published == self._stuck:
            return
        self.values = 0
        with self.lock:
            if self._rests and not waiting:
                return
            self._emptied.clear()
            self.lock.notify()
        sent = counters.published
        # No longer than it ran: late reads turn values bad, which is more to send.
        ran = time.monotonic() - self._resumed
        if not self._emptied.wait(min(_PAUSE, ran)) and counters.published == sent:
            self._stuck = sent
        self._resumed = time.monotonic()


class Publisher:
    """The queue (event loop) and the thread that empties it."""

    def __init__(self, keys: Keys, losses: SlowPuts) -> None:
        self.counters = Published()
        self.ended = asyncio.Event()  # the thread has ended, expected or not
        self._keys = keys
        self._losses = losses
        self._online: dict[str, bool] = {}  # by device
        self._session: zenoh.Session | None = None
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._waiting: dict[Hashable, _Entry] = {}
        self._urgent: dict[Hashable, _Entry] = {}
        self._value_keys: dict[Tag, str] = {}  # cached: building one takes as long as queueing it
        self._waiting_events = 0
        self._blocks = Counter[str]()  # sent since the start, by key
        self._closing = False
        self._turns = _Turns()
        self._thread: threading.Thread | None = None

    # -- event loop --

    def counts(self) -> dict[str, int]:
        """Counters since the start, by their names in the status."""
        return asdict(self.counters) | {"congested": self._losses.congested}

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

    def values(self, samples: Iterable[Sample]) -> None:
        """Queues samples; each is published unless a newer sample of its tag replaces it.

        Before the session is open samples are dropped: opening publishes all current values.
        """
        if self._session is None or self._closing:
            return
        stamp = self._session.new_timestamp
        with self._turns.lock:
            for sample in samples:
                key = self._value_keys.get(sample.tag) or self._value_key(sample)
                # Removed first, so that the entry moves to the end: stamps leave in order.
                if self._waiting.pop(key, None) is not None:
                    self.counters.superseded += 1
                self._waiting[key] = (stamp(), key, sample)
            self._turns.lock.notify()

    def scan(self, samples: Samples) -> None:
        """Queues the changed values of one read of a block, as `values` does."""
        if self._session is None or self._closing:
            return
        with self._turns.lock:
            older = self._waiting.get(samples.block)
            if older is None:
                keys = [self._value_keys.get(tag) or self._new_key(tag) for tag in samples.tags]
                stamp = self._session.new_timestamp
                puts = _Scan([stamp() for _ in keys], keys, samples)
                self._waiting[samples.block] = (None, "", puts)
                self._turns.lock.notify()
                return
            if isinstance(scan := older[2], _Scan):
                rest = scan.without({*samples.tags})  # it keeps its place
                self.counters.superseded += len(scan.keys) - len(rest.keys)
                self._waiting[samples.block] = (None, "", rest)
        self.values(samples)

    def pause(self, values: int) -> None:
        """Waits until the thread has sent what waits, `_PAUSE` at most, after many new values.

        Only values that were read count: reads must not wait for those that are put again.
        """
        self._turns.values += values
        self._turns.pause(self._waiting, self.counters)

    def _value_key(self, sample: Sample) -> str:
        if sample.reason is Reason.DISABLED:  # its tag may have gone already
            return self._keys.value(sample.tag.key)
        return self._new_key(sample.tag)

    def _new_key(self, tag: Tag) -> str:
        key = self._value_keys[tag] = self._keys.value(tag.key)
        return key

    def block(self, device: str, samples: Sequence[Sample]) -> None:
        """Queues the changed samples of one scan of a device, merged with a waiting block.

        A long block goes out in parts: many clients drop long messages.
        """
        if self._session is None or self._closing:
            return
        key = self._keys.block(device)
        merged: dict[str, Sample] = {}
        with self._turns.lock:
            for part in range(len(self._waiting)):
                older = self._waiting.pop((key, part), None)
                if older is None or not isinstance(older[2], dict):
                    break
                merged |= older[2]
            merged |= {sample.tag.name: sample for sample in samples}
            for part, some in enumerate(parts_of(merged)):
                self._waiting[key, part] = (self._session.new_timestamp(), key, some)
            self._turns.lock.notify()

    def events(self, samples: Iterable[Sample]) -> None:
        """Queues samples that all go out, in order (bar codes). Drops those beyond the limit."""
        for sample in samples:
            self._queue_event(self._keys.value(sample.tag.key), sample)

    def document(self, key: str, document: bytes) -> None:
        """Queues a status document, or the outcome of a write, which is urgent."""
        self._queue_event(key, document)

    def latest(self, key: str, make: Callable[[], bytes]) -> None:
        """Queues an urgent document that the publishing thread makes: only the latest of each key
        is put.

        Opening a session publishes all of them.
        """
        if self._session is None or self._closing:
            return
        with self._turns.lock:
            self._urgent.pop(key, None)
            self._urgent[key] = (self._session.new_timestamp(), key, make)
            self._turns.lock.notify()

    def set_online(self, device: str, online: bool) -> None:
        """Declares or undeclares the device's liveliness token."""
        self._online[device] = online
        if self._session is None:
            return
        key = self._keys.alive(device)
        with self._turns.lock:
            self._waiting[("token", device)] = (None, key, online)
            self._turns.lock.notify()

    def forget(self, devices: Iterable[str], tags: Iterable[Tag]) -> None:
        """Forgets devices and tags that the gateway no longer has. Their tokens end first."""
        for device in devices:
            self._online.pop(device, None)
        for tag in tags:
            self._value_keys.pop(tag, None)

    def _queue_event(self, key: str, data: Sample | bytes) -> None:
        urgent = key == self._keys.writes
        with self._turns.lock:
            waiting = len(self._urgent) if urgent else self._waiting_events
            if self._session is None or self._closing or waiting >= EVENTS_LIMIT:
                self.counters.dropped += 1
                return
            self._waiting_events += not urgent
            queue = self._urgent if urgent else self._waiting
            queue[object()] = (self._session.new_timestamp(), key, data)
            self._turns.lock.notify()

    # -- any thread --

    def stop(self, within: float) -> None:
        """Ends the thread once the queue is empty; waits at most `within` seconds for that."""
        with self._turns.lock:
            self._closing = True
            self._turns.lock.notify()
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
        while batch := self._next_batch():
            while batch:
                if not self._send_entry(session, batch.pop()):
                    return
                if self._urgent:
                    batch += self._next_batch()

    def _send_entry(self, session: zenoh.Session, entry: _Entry) -> bool:
        """Returns False if the session is closed."""
        stamp, key, data = entry
        before = time.monotonic()
        if isinstance(data, _Scan):
            return self._send_scan(session, data, before)
        try:
            self._send(session, stamp, key, data)
        except zenoh.ZError as error:
            if not _goes_on(session, key, error):
                return False
        now = time.monotonic()
        self._losses.sent(_tags(data), now - before, now)
        return True

    def _send_scan(self, session: zenoh.Session, scan: _Scan, before: float) -> bool:
        counters, losses, monotonic = self.counters, self._losses, time.monotonic
        samples, put, made = scan.samples, encoding.put_value, payload.plain_value
        parts = zip(scan.stamps, scan.keys, samples.tags, samples.parts(), strict=True)
        for stamp, key, tag, part in parts:
            try:
                if isinstance(part, Sample):
                    encoding.put(session, key, part, stamp)
                elif (data := made(part, samples.time)) is not None:
                    put(session, key, data, stamp)
                else:
                    encoding.put(session, key, good(tag, part, samples.time), stamp)
                counters.published += 1
            except zenoh.ZError as error:
                if not _goes_on(session, key, error):
                    return False
            now = monotonic()
            losses.sent((tag,), now - before, now)
            before = now
            if self._urgent:
                for entry in reversed(self._next_batch()):
                    if not self._send_entry(session, entry):
                        return False
                before = monotonic()
        return True

    def _next_batch(self) -> list[_Entry]:
        """Returns all urgent entries, or else all others that wait, the first at the end; empty
        only when the publisher ends.

        The caller frees the entries one by one: freeing 50,000 at once holds up the loop for 5 ms.
        """
        with self._turns.lock:
            while not (self._waiting or self._urgent or self._closing):
                self._turns.rest()
            if self._urgent:
                waiting, self._urgent = self._urgent, {}
            else:
                waiting, self._waiting = self._waiting, {}
                self._waiting_events = 0
        batch = list(waiting.values())
        batch.reverse()
        return batch

    def _send(
        self,
        session: zenoh.Session,
        stamp: zenoh.Timestamp | None,
        key: str,
        data: _Data,
    ) -> None:
        if isinstance(data, Sample):
            encoding.put(session, key, data, stamp)
        elif isinstance(data, bytes):
            encoding.put_json(session, key, data, stamp, urgent=key == self._keys.writes)
        elif isinstance(data, dict):
            self._blocks[key] += 1
            place = payload.place(str(session.zid()), self._blocks[key])
            encoding.put_json(session, key, payload.block(data.values()), stamp, place)
        elif isinstance(data, bool):
            self._set_token(session, key, declared=data)
            return
        else:
            encoding.put_json(session, key, data(), stamp, urgent=True)
        self.counters.published += 1

    def _set_token(self, session: zenoh.Session, key: str, *, declared: bool) -> None:
        if not declared:
            if token := self._tokens.pop(key, None):
                token.undeclare()  # type: ignore[no-untyped-call]  # Zenoh's stub lacks it
        elif key not in self._tokens:
            self._tokens[key] = session.liveliness().declare_token(key)


def _tags(data: _Data) -> Iterable[Tag]:
    if isinstance(data, Sample):
        return (data.tag,)
    return (sample.tag for sample in data.values()) if isinstance(data, dict) else ()


def _goes_on(session: zenoh.Session, key: str, error: zenoh.ZError) -> bool:
    """Logs the error of a put. Returns False if the session is closed."""
    if session.is_closed():
        return False
    log.warning("Zenoh put failed", key=key, error=str(error))
    return True


class ScanBatches:
    """Sorts the samples of a scan by how they are published. Event loop only; never blocks."""

    def __init__(self, publisher: Publisher, index: TagIndex) -> None:
        self._publisher = publisher
        self._index = index

    def publish(self, samples: Sequence[Sample]) -> None:
        """One call is one scan. Samples of event tags all go out, in order, none replaced."""
        if type(samples) is Samples and self._index.only_values:
            self._publisher.scan(samples)
        else:
            self._sort(samples)

    def _sort(self, samples: Sequence[Sample]) -> None:
        values = samples
        if any(sample.tag.publishing.event for sample in samples):
            self._publisher.events(sample for sample in samples if sample.tag.publishing.event)
            values = [sample for sample in samples if not sample.tag.publishing.event]
        if only_blocks := self._index.only_blocks:
            values = [sample for sample in values if sample.tag.device not in only_blocks]
        self._publisher.values(values)
        with_blocks = self._index.with_blocks
        if not with_blocks:
            return
        scans: dict[str, list[Sample]] = {}
        for sample in samples:
            if sample.tag.device in with_blocks:
                scans.setdefault(sample.tag.device, []).append(sample)
        for device, changed in scans.items():
            self._publisher.block(device, changed)
