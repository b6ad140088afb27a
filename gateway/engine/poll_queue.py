"""Sorts the polls of one line: by due time while they wait, by deadline when they are due."""

import heapq
import itertools
from collections import deque
from collections.abc import Iterable, Iterator

from gateway.engine.jobs import EXPEDITED, Poll

ROOM = 16  # entries of a heap in addition to twice the valid ones
Heap = list[tuple[float, int, Poll]]


class PollQueue:
    """Two heaps: polls that wait until they are due, and due polls by deadline.

    Deletion is lazy: a poll's `ticket` names its one valid entry. All other entries are stale,
    and are dropped when they are first, or when there are too many.
    """

    __slots__ = ("_most_due", "_most_waiting", "_tickets", "due", "expedited", "waiting")

    def __init__(self) -> None:
        self.waiting: Heap = []  # by due time
        self.due: Heap = []  # by deadline; after `ripen` the first entry is valid
        self.expedited: deque[Poll] = (
            deque()
        )  # before all due polls; after `ripen` the first is valid
        self._tickets = itertools.count()
        self._most_waiting = self._most_due = ROOM

    def push(self, poll: Poll) -> None:
        """Adds a poll that waits until it is due, if its device is online."""
        if not (poll.live and poll.device.health.online) or poll.ticket == EXPEDITED:
            return
        poll.ticket = next(self._tickets)
        waiting = self.waiting
        heapq.heappush(waiting, (poll.due, poll.ticket, poll))
        if len(waiting) > self._most_waiting:
            waiting[:] = [e for e in waiting if e[2].live and e[2].ticket == e[1]]
            self._most_waiting = _tidy(waiting)

    def push_all(self, polls: Iterable[Poll]) -> None:
        for poll in polls:
            self.push(poll)

    def expedite(self, poll: Poll) -> None:
        """Puts the poll before all due polls."""
        if poll.ticket != EXPEDITED:
            poll.ticket = EXPEDITED
            self.expedited.append(poll)

    def ripen(self, now: float) -> bool:
        """Moves polls that became due to their heap. Returns True if a poll can be sent."""
        waiting, due, expedited = self.waiting, self.due, self.expedited
        while waiting and waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(waiting)
            if poll.ticket == ticket and poll.live:
                heapq.heappush(due, (poll.due + poll.block.every, ticket, poll))
        while due and (due[0][2].ticket != due[0][1] or not _is_valid(due[0])):
            heapq.heappop(due)
        if len(due) > self._most_due:
            due[:] = [entry for entry in due if _is_valid(entry)]
            self._most_due = _tidy(due)
        while expedited and not (expedited[0].live and expedited[0].device.health.online):
            expedited.popleft()
        return bool(due or expedited)

    def valid(self) -> Iterator[Poll]:
        """Yields the due polls, in no order."""
        return (entry[2] for entry in self.due if _is_valid(entry))


def _is_valid(entry: tuple[float, int, Poll]) -> bool:
    poll = entry[2]
    return poll.ticket == entry[1] and poll.live and poll.device.health.online


def _tidy(heap: Heap) -> int:
    """Restores the heap. Returns the number of entries at which it is cleaned again."""
    heapq.heapify(heap)
    return 2 * len(heap) + ROOM
