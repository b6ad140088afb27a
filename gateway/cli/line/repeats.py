"""Log entries that repeat: the first at once, then the last one of each minute with their number.

A bad line makes several entries a second: hundreds of megabytes a day for some devices.
"""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, MutableMapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import structlog

from gateway.contract import audited
from gateway.contract.rate_limit import RateLimit

Entry = MutableMapping[str, Any]
Key = tuple[str, ...]

EVERY = 60.0  # seconds
BURST = 20  # changes of one state at once; different entries of one topic that are told apart
# Changes of these are logged at once, up to `BURST` of them: a cable is plugged again soon.
_STATES = frozenset(
    {
        *("alarm", "device", "file", "gateway", "history", "line", "standby state"),
        *("Zenoh link", "Zenoh session"),
    }
)
_SOURCE = "line", "device", "logger"
_UNIQUE = frozenset({"address", "bytes", "id"})  # different in each entry of one kind
_AGAIN = "repeated"  # marks an entry that has waited here


@dataclass(slots=True)
class _Waiting:
    method: str
    entry: Entry
    count: int


@dataclass(slots=True)
class _Topic:
    """Entries of one noun and source, such as `device online` and `device offline` of a device."""

    limits: dict[Key, RateLimit] = field(default_factory=dict)
    waiting: OrderedDict[Key, _Waiting] = field(default_factory=OrderedDict)  # last one last
    due: float = 0.0


class Repeats:
    """A processor of structlog; `flush` logs what waits. Any thread may call both."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._topics: dict[Key, _Topic] = {}

    def __call__(self, _logger: object, method: str, entry: Entry) -> Entry:
        """Raises `DropEvent` for an entry that waits for the next `flush`."""
        if entry.pop(_AGAIN, False) or entry["event"] in audited.EVENTS:
            return entry
        event = str(entry["event"])
        noun = "" if "logger" in entry else event.rpartition(" ")[0]
        source = noun, *(str(entry.get(name)) for name in _SOURCE), _host(entry)
        with self._lock:
            now = self._clock()
            topic = self._topics.setdefault(source, _Topic())
            if self._passes(topic, event, entry, now, BURST if noun in _STATES else 1):
                return entry
            key = _key(event, entry)
            before = topic.waiting.pop(key, None)
            if before is None and len(topic.waiting) >= BURST:
                key, before = topic.waiting.popitem()
            if not topic.waiting and before is None:
                topic.due = now + EVERY
            count = 1 if before is None else before.count + 1
            last = {**entry, "last": datetime.now(UTC).isoformat(timespec="seconds")}
            topic.waiting[key] = _Waiting(method, last, count)
        raise structlog.DropEvent

    @staticmethod
    def _passes(topic: _Topic, event: str, entry: Entry, now: float, burst: int) -> bool:
        if topic.waiting and burst > 1:  # the order of states must not change
            return False
        key = _key(event, entry)
        if key not in topic.limits and len(topic.limits) >= BURST:
            idle = [known for known, one in topic.limits.items() if one.idle_since(now) >= EVERY]
            for known in idle:
                del topic.limits[known]
            if not idle:
                return False
        return topic.limits.setdefault(key, RateLimit(burst, EVERY)).allows(now)

    def flush(self) -> None:
        """Logs the last of the entries that have waited for a minute, in their order."""
        for waited in [*self._due()]:
            entry = {**waited.entry, "unlogged": waited.count - 1, _AGAIN: True}
            if waited.count == 1:
                del entry["unlogged"]
            getattr(structlog.get_logger(__name__), waited.method)(entry.pop("event"), **entry)

    def _due(self) -> Iterator[_Waiting]:
        with self._lock:
            now = self._clock()
            for topic in self._topics.values():
                if topic.waiting and now >= topic.due:
                    yield from topic.waiting.values()
                    for key in topic.waiting:  # the next one of them has its minute again
                        if key in topic.limits:
                            topic.limits[key].allows(now)
                    topic.waiting.clear()


def _key(event: str, entry: Entry) -> Key:
    texts = (f"{k}={v}" for k, v in sorted(entry.items()) if isinstance(v, str))
    return event, *(text for text in texts if text.partition("=")[0] not in _UNIQUE)


def _host(entry: Entry) -> str:
    return str(entry.get("address", "")).rpartition(":")[0]
