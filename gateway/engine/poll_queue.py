"""Polls of one line by due time, then by deadline."""

import heapq
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from gateway.engine.jobs import EXPEDITED, NOT_QUEUED, Poll

ROOM = 16  # entries a heap may hold beside twice the valid ones
_Heap = list[tuple[float, int, Poll]]


class PollQueue:
    """Two heaps: polls that wait until they are due, and due polls by deadline.

    Deletion is lazy: a poll's `ticket` names its one valid entry. All other entries are stale,
    and are dropped when they come up or when there are too many.
    """

    __slots__ = ("_due", "_expedited", "_most_due", "_most_waiting", "_tickets", "_waiting")

    def __init__(self) -> None:
        self._tickets = itertools.count()
        self._waiting: _Heap = []
        self._due: _Heap = []
        self._expedited: deque[Poll] = deque()
        self._most_waiting = self._most_due = ROOM

    def push(self, poll: Poll) -> None:
        """The poll waits until it is due. Polls of a device that is not online are left out."""
        if not (poll.live and poll.device.health.online) or poll.ticket == EXPEDITED:
            return
        poll.ticket = next(self._tickets)
        waiting = self._waiting
        heapq.heappush(waiting, (poll.due, poll.ticket, poll))
        if len(waiting) > self._most_waiting:
            waiting[:] = [e for e in waiting if e[2].live and e[2].ticket == e[1]]
            self._most_waiting = _tidy(waiting)

    def push_all(self, polls: Iterable[Poll]) -> None:
        for poll in polls:
            self.push(poll)

    def expedite(self, poll: Poll) -> None:
        """The poll goes before all due polls."""
        if poll.ticket != EXPEDITED:
            poll.ticket = EXPEDITED
            self._expedited.append(poll)

    def ripen(self, now: float) -> bool:
        """Moves polls that have come due to their heap. True when there is one to hand out."""
        waiting, due, expedited = self._waiting, self._due, self._expedited
        while waiting and waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(waiting)
            if poll.ticket == ticket and poll.live:
                heapq.heappush(due, (poll.due + poll.block.every, ticket, poll))
        while due and not _is_valid(due[0]):
            heapq.heappop(due)
        if len(due) > self._most_due:
            due[:] = [entry for entry in due if _is_valid(entry)]
            self._most_due = _tidy(due)
        while expedited and not (expedited[0].live and expedited[0].device.health.online):
            expedited.popleft()
        return bool(due or expedited)

    @property
    def next_due(self) -> float:
        """When the next waiting poll comes due."""
        return self._waiting[0][0] if self._waiting else float("inf")

    @property
    def first(self) -> Poll | None:
        """The due poll with the earliest deadline, after `ripen`."""
        return self._due[0][2] if self._due else None

    @property
    def first_expedited(self) -> Poll | None:
        """After `ripen`."""
        return self._expedited[0] if self._expedited else None

    def due(self, which: Callable[[Poll], bool]) -> Iterator[Poll]:
        """The due polls of which that is true, in no order."""
        return (entry[2] for entry in self._due if _is_valid(entry) and which(entry[2]))

    def take(self, poll: Poll) -> None:
        """The poll is handed out: its entry is stale now."""
        if poll.ticket == EXPEDITED:
            self._expedited.remove(poll)
        poll.ticket = NOT_QUEUED


def _is_valid(entry: tuple[float, int, Poll]) -> bool:
    poll = entry[2]
    return poll.ticket == entry[1] and poll.live and poll.device.health.online


def _tidy(heap: _Heap) -> int:
    """Restores the heap. Returns the most entries it may have until it is looked through again."""
    heapq.heapify(heap)
    return 2 * len(heap) + ROOM
