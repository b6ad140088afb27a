"""One direction of a Zenoh link: queues by priority, and a wire that takes time.

Messages wait in the queue of their priority. The wire takes them from the first queue that has
one, as far as the buffer of the system has room. A message that may be dropped waits for room as
long as the drop limit; then it is lost, and so are the next ones until a batch leaves the queue.
Any other message waits until it has room. If the wire takes nothing meanwhile, for as long as the
link's patience, the link is closed.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple

from tests.sim.threads import Queue, Turns

OVERHEAD = 40  # bytes of a message beside its key and payload


class Rank(IntEnum):
    """The priorities that the gateway and its clients use."""

    CONTROL = 0
    ANSWER = 1
    VALUE = 2


class Message(NamedTuple):
    """A message and its length in bytes. `at`: when it was put."""

    content: Any
    size: int
    at: float


class Limits(NamedTuple):
    """Sizes in bytes, times in seconds."""

    queues: tuple[int, int, int]
    batch: int
    drop_after: float
    close_after: float


@dataclass(eq=False)
class _Waiting:
    limit: int
    batch: int
    messages: deque[Message] = field(default_factory=deque)
    size: int = 0  # bytes that are not free for new messages
    taken: int = 0  # bytes of these that left, in a batch that is not whole
    congested: bool = False
    room: Queue = field(default_factory=deque)

    def has_room(self, size: int) -> bool:
        return not self.messages or self.size + size <= self.limit

    def take(self) -> Message:
        """Takes out the first message. Room gets free by whole batches."""
        message = self.messages.popleft()
        self.taken += message.size
        if self.taken >= self.batch or not self.messages:
            self.size -= self.taken
            self.taken = 0
            self.congested = False
        return message


@dataclass(eq=False)
class Pipe:
    """`rate`: bytes per second; 0: nothing passes. `latency`: seconds. `buffer`: bytes."""

    turns: Turns
    limits: Limits
    rate: float
    latency: float
    buffer: int
    deliver: Callable[[Any], None]
    stuck: Callable[[], None]  # closes the link
    lost: int = 0  # messages
    lost_at: float = float("-inf")
    slowest: float = 0.0  # seconds from put to delivery, since the last look
    closed: bool = False

    def __post_init__(self) -> None:
        self.loop = self.turns.loop
        self._queues = [_Waiting(limit, self.limits.batch) for limit in self.limits.queues]
        self._on_wire: deque[Message] = deque()
        self._on_wire_size = 0
        self._arriving: deque[Message] = deque()
        self._timer: Any = None
        self._taken = 0  # messages that left a queue

    # -- a thread of the gateway, or the loop --

    def put(self, rank: Rank, content: Any, size: int, *, block: bool) -> bool:
        """Returns False if the message is lost. Waits for room: only on a thread."""
        message = Message(content, size + OVERHEAD, self.loop.time())
        queue = self._queues[rank]
        if not self.closed and not queue.has_room(message.size):
            if block:
                self._wait_for_ever(queue, message.size)
            elif not self._wait(queue, message.size):
                self.lose()
                return False
        if self.closed:
            return False
        self._add(queue, message)
        return True

    def force(self, rank: Rank, content: Any, size: int) -> None:
        """Puts a message that Zenoh itself sends, whether or not there is room."""
        if not self.closed:
            message = Message(content, size + OVERHEAD, self.loop.time())
            self._add(self._queues[rank], message)

    def offer(self, rank: Rank, content: Any, size: int) -> bool:
        """Puts a message without waiting for room: a router that has none drops it."""
        if self.closed or not self._queues[rank].has_room(size + OVERHEAD):
            self.lose()
            return False
        return self.put(rank, content, size, block=False)

    def _add(self, queue: _Waiting, message: Message) -> None:
        queue.messages.append(message)
        queue.size += message.size
        self._send()

    def lose(self) -> None:
        self.lost += 1
        self.lost_at = self.loop.time()

    def _wait(self, queue: _Waiting, size: int) -> bool:
        until = self.loop.time() + self.limits.drop_after
        while not queue.congested and not self.closed:
            left = until - self.loop.time()
            if left <= 0:
                queue.congested = True
                break
            self.turns.wait(queue.room, left + 1e-6)
            if queue.has_room(size):
                return True
        return False

    def _wait_for_ever(self, queue: _Waiting, size: int) -> None:
        while not self.closed and not queue.has_room(size):
            taken = self._taken
            if not self.turns.wait(queue.room, self.limits.close_after) and taken == self._taken:
                self.stuck()

    # -- the wire --

    def set_rate(self, rate: float) -> None:
        self.rate = rate
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._send()

    def oldest(self) -> float:
        """Returns how long the oldest value waits."""
        waiting = [*self._queues[Rank.VALUE].messages, *self._on_wire, *self._arriving]
        return max((self.loop.time() - message.at for message in waiting), default=0.0)

    def close(self) -> None:
        """Loses all that is on its way."""
        self.closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._arriving.clear()
        self._on_wire.clear()
        for queue in self._queues:
            queue.messages.clear()
            self.turns.wake(queue.room, len(queue.room))

    def _send(self) -> None:
        while self._on_wire_size < self.buffer and not self.closed:
            queue = next((queue for queue in self._queues if queue.messages), None)
            if queue is None:
                break
            message = queue.take()
            self._taken += 1
            self._on_wire.append(message)
            self._on_wire_size += message.size
            if not queue.taken:
                self.turns.wake(queue.room, len(queue.room))
        if self._timer is None and self._on_wire and self.rate:
            self._timer = self.loop.call_later(self._on_wire[0].size / self.rate, self._sent)

    def _sent(self) -> None:
        message = self._on_wire.popleft()
        self._on_wire_size -= message.size
        self._arriving.append(message)
        self.loop.call_later(self.latency, self._arrive)
        self._timer = None
        self._send()

    def _arrive(self) -> None:
        if self._arriving:  # otherwise the link was closed
            message = self._arriving.popleft()
            self.slowest = max(self.slowest, self.loop.time() - message.at)
            self.deliver(message.content)
