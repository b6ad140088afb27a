"""Replies that are not for the gateway, and the theory of which nobody can tell."""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum

APART = 0.25  # seconds between two questions, after which an older answer cannot be told
SECONDS_APART = 3.0  # between a second answer and the last answer that it displaced
CLEAN = 600.0  # seconds without a foreign reply, after which one more scan may be wrong
Shape = tuple[object, ...]


class Case(Enum):
    """A scan with the values of a foreign reply. The text is the count in the total."""

    FIRST = "wrong scans before evidence"
    SAME = ""  # another tag of that scan
    SECOND = "wrong again before evidence"
    AFTER = "wrong scans after evidence"


@dataclass(eq=False)
class Foreign:
    """Replies to another master, or of an unknown station with the number of another.

    A reply tells its station, its function and its length, and nothing else: together its shape.
    So the answer that a station gives to another master's question of the same shape is the
    answer, if it arrives after the question of the gateway and before its own answer. No check of
    any master can tell the two apart. The same is true for the answer of a second station with
    this number to this very question. All else can be told, and breaks a rule: an answer of
    another shape, one that arrived before the question, and the answer to an older question of
    the gateway, also if another master's answer had ended that one.

    An older answer, one that was given twice or whose place a second answer had taken, can be told
    only by its shape. So the gateway keeps the shapes of its questions apart where the station has
    addresses for it: `shapes` of them, three at most. Nobody can tell an older answer if as many
    other questions lie between the two as there are other shapes, or a quarter of a second.
    """

    shape_of: Callable[[bytes], Shape | None]  # of a request
    reads: deque[bytes] = field(default_factory=lambda: deque(maxlen=12))  # of the gateway
    asked: bytes = b""  # what the gateway sent last
    asks: asyncio.Event = field(default_factory=asyncio.Event)  # the gateway has just asked
    unknown_at: float = -1.0  # when an unknown station answered the open question last
    _others: list[tuple[bytes, bytes]] = field(default_factory=list)  # since then, with replies
    _unknown: list[bytes] = field(default_factory=list)  # replies of an unknown station since then
    second_at: float = -math.inf  # when a second answer to a question was given last
    evidence_at: float = -math.inf  # when a reply to no request arrived last
    _wrong_at: float = -math.inf  # the last wrong scan
    _own: deque[tuple[bytes, bytes]] = field(default_factory=lambda: deque(maxlen=64))
    _asked: deque[tuple[float, bytes]] = field(default_factory=lambda: deque(maxlen=64))

    def sent(self, request: bytes, now: float, *, resync: bool, proves: bool) -> None:
        """The gateway asks; `proves`: to prove the answer to the question before.

        Other masters do not repeat its resyncs.
        """
        self.asks.set()
        if not proves:
            self.asked = request
            self._asked.append((now, request))
            self._others.clear()
            self._unknown.clear()
        if not resync and request not in self.reads and self.shape_of(request):
            self.reads.append(request)

    def answered(self, request: bytes, reply: bytes) -> None:
        """A station replies to the gateway, perhaps late."""
        self._own.append((request, reply))

    def answered_other(self, request: bytes, reply: bytes, now: float, *, unknown: bool) -> None:
        """A reply to another master arrived; `unknown`: of an unknown station to the gateway."""
        self.second_at = now
        if unknown:
            self._unknown.append(reply)
            self._own.append((request, reply))
            if request != self.asked:
                return
        self._others.append((request, reply))
        if unknown:
            self.unknown_at = now

    def is_alone(self, own: Sequence[bytes], heard: bytes) -> bool:
        """Only an unknown station has answered: no reply of the right one has arrived yet.

        `own`: what the right one has replied. A reply of both may be the same.
        """
        return all(heard.count(reply) <= self._unknown.count(reply) for reply in own)

    def wrong_scan(self, now: float) -> Case:
        """Returns what is wrong about a scan with the values of a foreign reply."""
        before, self._wrong_at = self._wrong_at, now
        if before == now:
            return Case.SAME
        if now - self.evidence_at < CLEAN:
            return Case.AFTER
        return Case.FIRST if before <= self.evidence_at else Case.SECOND

    def repeated(self, now: float) -> None:
        """A reply to the gateway will arrive a second time."""
        self.second_at = now

    def took_older(self, heard: bytes, shapes: int, now: float) -> bool:
        """The open question was ended by an answer to an older one that nobody can tell.

        `shapes`: of which the gateway can choose for the open question.
        """
        shape = self.shape_of(self.asked)
        if shape is None or now - self.second_at > SECONDS_APART:
            return False
        older = [request for request, reply in self._own if reply in heard]
        older = [request for request in older if self.shape_of(request) == shape]
        asked = list(self._asked)
        since, _ = asked.pop()
        for between, (at, request) in enumerate(reversed(asked)):
            if request in older and (between >= shapes - 1 or since - at >= APART):
                return True
        return False

    def took(self, heard: bytes) -> bool:
        """The open question, after which this arrived, was ended by an answer that nobody can tell.

        `heard` begins with the first byte after the question.
        """
        shape = self.shape_of(self.asked)
        for request, reply in self._others if shape is not None else ():
            place = heard.find(reply)
            if place >= 0 and self.shape_of(request) == shape:
                before = heard[:place]
                return not any(
                    said in before and self.shape_of(asked) == shape for asked, said in self._own
                )
        return False
