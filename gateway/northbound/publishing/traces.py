"""The trace of each line: its bytes and exchanges, published only while a client subscribes."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import orjson
import zenoh

from gateway.contract.interfaces import Plant
from gateway.contract.keys import Keys
from gateway.line.exchanges import decoded, heard, samples_of
from gateway.line.wire_log import Event, Learned, Piece
from gateway.northbound.requests.inbox import Inbox

PUT_EVERY = 0.1  # seconds; a fast line has hundreds of exchanges in a second
MOST_WAITING = 2000  # events of one put; those beyond are counted

# Puts a document on a key. Never blocks.
Put = Callable[[str, bytes], None]


@dataclass(eq=False)
class Traces:
    """Watches a line from the first subscriber of its trace to the end of the last."""

    _keys: Keys
    _lines: Plant
    _put: Put
    _tapped: dict[str, "Tap"] = field(default_factory=dict)

    def declare(self, session: zenoh.Session, inbox: Inbox[tuple[str, bool]]) -> list[object]:
        """Declares the traces. Blocks: not on the event loop. The caller keeps the results."""
        declared: list[object] = []
        for line in self._lines.wire_logs():
            publisher = session.declare_publisher(self._keys.trace(line))

            def changed(status: zenoh.MatchingStatus, line: str = line) -> None:
                inbox((line, status.matching))

            handler = zenoh.handlers.Callback(changed, indirect=False)
            declared += [publisher, publisher.declare_matching_listener(handler)]
            if publisher.matching_status.matching:  # type: ignore[attr-defined]  # a wrong stub
                inbox((line, True))  # its client was there before the listener
        return declared

    def inbox(self) -> Inbox[tuple[str, bool]]:
        return Inbox(self._changed, lambda _: None)

    def _changed(self, news: tuple[str, bool], _at: float) -> None:
        line, watched = news
        wire_log = self._lines.wire_logs()[line]
        tap = self._tapped.get(line)
        if watched and tap is None:
            tap = self._tapped[line] = Tap(partial(self._put, self._keys.trace(line)))
            wire_log.listen(tap.take)
        elif not watched and tap is not None:
            del self._tapped[line]
            wire_log.forget(tap.take)
            tap.close()


class Tap:
    """Collects the events of one line, and puts them together."""

    def __init__(self, put: Callable[[bytes], None]) -> None:
        self._put = put
        self._loop = asyncio.get_running_loop()
        self._behind = time.time() - self._loop.time()  # seconds, of the loop's clock
        self._waiting: list[tuple[float, Event]] = []
        self._missed = 0
        self._number = 0  # of the document
        self._timer: asyncio.TimerHandle | None = None

    def take(self, event: Event) -> None:
        """Takes an event of the wire log. The line waits meanwhile."""
        if len(self._waiting) >= MOST_WAITING:
            self._missed += 1
            return
        self._waiting.append((self._loop.time(), event))
        if self._timer is None:
            self._timer = self._loop.call_later(PUT_EVERY, self._flush)

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _flush(self) -> None:
        events = [self._fields(at, event) for at, event in self._waiting]
        self._number += 1
        document = {"number": self._number, "missed": self._missed, "events": events}
        self._waiting, self._missed, self._timer = [], 0, None
        self._put(orjson.dumps(document, default=str))

    def _fields(self, at: float, event: Event) -> dict[str, Any]:
        """Returns one event; times in seconds since 1970."""
        if isinstance(event, Learned):
            return {"time": self._since_1970(at), "took": 0.0, **heard(event.samples)._asdict()} | {
                "values": {one.tag.key: one.value for one in event.samples}
            }
        if isinstance(event, Piece):
            return {"time": self._since_1970(at), "way": event.way, "bytes": event.data.hex(" ")}
        return {
            "time": self._since_1970(event.begun),
            "took": round(event.ended - event.begun, 6),
            **decoded(event)._asdict(),
            "values": {one.tag.key: one.value for one in samples_of(event)},
        }

    def _since_1970(self, at: float) -> float:
        return round(at + self._behind, 6)
