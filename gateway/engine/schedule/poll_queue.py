"""Sorts the polls of one line: by due time while they wait, by deadline when they are due."""

import heapq
import itertools
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

from gateway.engine.device.device import Device
from gateway.engine.device.reply_shapes import ReplyShapes
from gateway.engine.jobs.poll_entry import EXPEDITED, NOT_QUEUED, ON_DEMAND, PollEntry

ROOM = 16  # entries of a heap in addition to twice the valid ones
OVERTAKEN, LOOKED_AT = 0.5, 32  # seconds, and the first entries of a heap: about the next polls
NO_PLACE, LATE = -1, -2  # places of a device: nothing is due; its first poll is late
Heap = list[tuple[float, int, PollEntry]]


@dataclass(slots=True, eq=False)
class DuePolls:
    """The due polls of one device, by deadline."""

    device: Device
    heap: Heap = field(default_factory=list)
    place: int = NO_PLACE  # the ticket of the device's one valid entry in `PollQueue.in_time`
    most: int = ROOM

    def move(self, place: int) -> None:
        """Notes its one valid place among the devices."""
        self.place = place

    def first(self) -> PollEntry | None:
        """Returns the poll with the earliest deadline, after it has dropped stale entries."""
        heap = self.heap
        while heap:
            entry = heap[0]
            poll = entry[2]
            if poll.ticket == entry[1] and poll.live and poll.device.health.online:
                return poll
            heapq.heappop(heap)
        return None


class PollQueue:
    """Polls that wait until they are due, and due polls by device.

    A device has one place among the others: by the deadline of its first poll while that is in
    time, by its recent use of the wire when that is late. So a decision takes O(log n).

    Deletion is lazy: a poll's `ticket` names its one valid entry. All other entries are stale,
    and are dropped when they are first, or when there are too many.
    """

    __slots__ = (
        "_late",
        "_most_in_time",
        "_most_waiting",
        "_own",
        "_shared",
        "_tickets",
        "by_device",
        "due",
        "expedited",
        "in_time",
        "waiting",
    )

    def __init__(self, *, shared: bool = True) -> None:
        """`shared`: the line has several devices. A single one needs no place among others."""
        self.waiting: Heap = []  # by due time
        self.by_device: dict[Device, DuePolls] = {}
        self._shared = shared
        self._own: DuePolls | None = None  # of the single device
        self.in_time: list[tuple[float, int, DuePolls]] = []  # by the deadline of the first poll
        self._late: list[tuple[float, int, DuePolls]] = []  # by use of the wire
        self.due: PollEntry | None = None  # after `ripen`: the due poll that goes first
        # Before all due polls; after `ripen` the first one is valid.
        self.expedited: deque[PollEntry] = deque()
        self._tickets = itertools.count()
        self._most_waiting = self._most_in_time = ROOM

    def push(self, poll: PollEntry) -> None:
        """Adds a poll that waits until it is due, if its device is online."""
        if not (poll.live and poll.device.health.online) or poll.ticket <= EXPEDITED:
            return
        poll.ticket = next(self._tickets)
        waiting = self.waiting
        heapq.heappush(waiting, (poll.due, poll.ticket, poll))
        if len(waiting) > self._most_waiting:
            waiting[:] = [e for e in waiting if e[2].live and e[2].ticket == e[1]]
            self._most_waiting = _tidy(waiting)

    def push_all(self, polls: Iterable[PollEntry]) -> None:
        for poll in polls:
            self.push(poll)

    def expedite(self, poll: PollEntry, *, on_demand: bool = False) -> None:
        """Puts the poll before all due polls, behind those that were before; on demand behind all
        that are not."""
        if on_demand and poll.ticket > EXPEDITED:
            poll.queue(ON_DEMAND)
            self.expedited.append(poll)
        elif not on_demand and poll.ticket != EXPEDITED:
            if poll.ticket == ON_DEMAND:
                self.expedited.remove(poll)
            place = sum(other.ticket == EXPEDITED for other in self.expedited)
            poll.ticket = EXPEDITED
            self.expedited.insert(place, poll)

    def first_to_differ(self, first: PollEntry, shapes: ReplyShapes, now: float) -> PollEntry:
        """Returns the first due poll, or in its place one of the next whose reply has another shape
        than those just before. It must not be much later, nor make the first one late."""
        heap = self.by_device[first.device].heap
        if len(heap) == 1 or not shapes.collides(first.block, now):
            return first
        deadline = heap[0][0]
        if now < deadline < now + OVERTAKEN:
            return first
        for later in sorted(heap[1:LOOKED_AT]):
            if later[0] > deadline + OVERTAKEN:
                break
            if _is_valid(later) and not shapes.collides(later[2].block, now):
                later[2].overtake(later[0] - deadline if deadline < now else 0.0)
                return later[2]
        return first

    @property
    def keeps_back_on_demand(self) -> bool:
        """Polls on demand are behind others: new ones of these may come again and again."""
        waiting = self.expedited
        return len(waiting) > 1 and waiting[0].ticket != waiting[-1].ticket == ON_DEMAND

    def return_due(self, now: float) -> None:
        """Makes polls on demand that are due by now due polls like others."""
        due = [poll for poll in self.expedited if poll.ticket == ON_DEMAND and poll.due <= now]
        for poll in due:
            self.expedited.remove(poll)
            poll.queue(NOT_QUEUED)
            self.push(poll)

    def put_off(self, poll: PollEntry, when: float) -> None:
        """Has the poll wait until `when`."""
        if poll.ticket <= EXPEDITED:
            self.expedited.remove(poll)
            poll.queue(NOT_QUEUED)
        poll.put_off(when)
        self.push(poll)

    def ripen(self, now: float) -> bool:
        """Moves polls that became due, and finds the first. Returns True if one can be sent."""
        waiting, expedited = self.waiting, self.expedited
        while waiting and waiting[0][0] <= now:
            _, ticket, poll = heapq.heappop(waiting)
            if poll.ticket == ticket and poll.live:
                self._add(poll)
        while expedited and not (expedited[0].live and expedited[0].device.health.online):
            expedited.popleft()
        if self._shared:
            self.due = due = self._first(now)
        else:
            self.due = due = self._own.first() if self._own is not None else None
        return due is not None or bool(expedited)

    def more(self, device: Device, most: int, held: Collection[PollEntry] = ()) -> list[PollEntry]:
        """Takes out more polls of the device: expedited ones, then due ones by deadline.

        `held`: polls that were read, and have not ended yet. A client may wait for their next read.
        """
        ready = (one for one in self.expedited if one.device is device and one.live)
        taken = [one for one in ready if one not in held][:most]
        for one in taken:
            self.expedited.remove(one)
        own = self.by_device.get(device)
        while own is not None and len(taken) < most and (poll := own.first()) is not None:
            heapq.heappop(own.heap)
            taken.append(poll)
        return taken

    def valid(self) -> Iterator[PollEntry]:
        """Yields the due polls, in no order."""
        heaps = (own.heap for own in self.by_device.values())
        return (entry[2] for heap in heaps for entry in heap if _is_valid(entry))

    @property
    def is_late(self) -> bool:
        """True if a deadline has passed. Not known on the line of a single device."""
        return bool(self._late)

    @property
    def entries(self) -> int:
        """The number of all entries, also of stale ones."""
        due = sum(len(own.heap) for own in self.by_device.values())
        return len(self.waiting) + due + len(self.expedited)

    def _add(self, poll: PollEntry) -> None:
        own = self.by_device.get(poll.device)
        if own is None:
            own = self._own = self.by_device[poll.device] = DuePolls(poll.device)
        heap = own.heap
        deadline = poll.due + poll.block.every  # as `poll.deadline`, which is slower
        if deadline > poll.soon:
            deadline = poll.soon
        heapq.heappush(heap, (deadline, poll.ticket, poll))
        if len(heap) > own.most:
            heap[:] = [entry for entry in heap if _is_valid(entry)]
            own.most = _tidy(heap)
            if not heap:  # its device went offline while it waited, as did all others
                return
        if self._shared and own.place != LATE and heap[0][2] is poll:
            self._place(own)

    def _place(self, own: DuePolls) -> None:
        """Gives the device its place by the deadline of its first poll."""
        deadline, own.place, _ = own.heap[0]
        in_time = self.in_time
        heapq.heappush(in_time, (deadline, own.place, own))
        if len(in_time) > self._most_in_time:
            in_time[:] = [entry for entry in in_time if entry[2].place == entry[1]]
            heapq.heapify(in_time)
            self._most_in_time = 2 * len(in_time) + ROOM

    def _first(self, now: float) -> PollEntry | None:
        """Returns the due poll with the earliest deadline.

        If deadlines have passed: the first poll of the late device that used the wire least.
        """
        first = self._first_in_time(now)
        if self._late:  # a device there may have become punctual again
            first = self._first_late(now) or self._first_in_time(now)
        return first

    def _first_in_time(self, now: float) -> PollEntry | None:
        """Returns the first poll that is in time, after it has moved late devices."""
        in_time = self.in_time
        while in_time:
            deadline, ticket, own = in_time[0]
            if own.place != ticket:
                heapq.heappop(in_time)
                continue
            first = own.first()
            if first is not None and first.ticket == ticket and deadline >= now:
                return first
            heapq.heappop(in_time)
            if first is None:
                own.place = NO_PLACE
            elif first.ticket != ticket:
                self._place(own)
            else:
                own.move(LATE)
                heapq.heappush(self._late, (own.device.use, ticket, own))
        return None

    def _first_late(self, now: float) -> PollEntry | None:
        """Returns the first poll of the late device that used the wire least."""
        late = self._late
        while late:
            use, ticket, own = late[0]
            first = own.first()
            if first is None or own.heap[0][0] >= now:
                heapq.heappop(late)
                own.move(NO_PLACE)
                if first is not None:
                    self._place(own)
            elif use < own.device.use:  # it has used the wire since
                heapq.heapreplace(late, (own.device.use, ticket, own))
            else:
                return first
        return None


def _is_valid(entry: tuple[float, int, PollEntry]) -> bool:
    poll = entry[2]
    return poll.ticket == entry[1] and poll.live and poll.device.health.online


def _tidy(heap: Heap) -> int:
    """Restores the heap. Returns the number of entries at which it is cleaned again."""
    heapq.heapify(heap)
    return 2 * len(heap) + ROOM
