"""A device server or radio between a port and its wire: it delays bytes, but keeps their order."""

import asyncio
import math
from collections import deque
from functools import partial
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.sim.wire import Master, Sending, SimWire, Speaker

SERVER_WAITS = 0.25  # seconds between two kept requests, and for a reply while it buffers
REST = 0.003  # seconds between a reply and the next buffered request


class DeviceServer:
    """Passes requests to the wire and replies to the connection.

    `stalled`: it keeps the requests, and passes them on later. `buffering`: it passes on one
    request at a time. `lasting`: it keeps its bytes while the connection is reset.
    """

    def __init__(self, wire: "SimWire") -> None:
        self._wire = wire
        self.stalled = False
        self.buffering = False
        self._draining = False  # it buffers until it has kept nothing
        self.lasting = False
        self._kept: deque[tuple[bytes, Master | None]] = deque()  # the first is being sent
        self._turn = 0
        self._behind = -math.inf
        self._unread: list[bytes] = []  # replies that arrived while no connection was open
        # By station that is held up: its replies, or the requests to it and who asked.
        self._replies: dict[Speaker, list[bytes]] = {}
        self._requests: dict[Speaker, list[tuple[bytes, bytes]]] = {}
        self._rest = REST

    # Requests

    def send(self, data: bytes, start: float, master: "Master | None" = None) -> None:
        if self.stalled or self._kept or self.buffering:
            self._kept.append((data, master))
            if self.buffering and not self.stalled and len(self._kept) == 1:
                self._say_kept()
        else:
            self._wire.say_request(data, start, master)

    @property
    def behind(self) -> float:
        """The last time at which it had kept bytes."""
        keeps = self.stalled or (self._kept and not self.buffering) or self._requests
        return _now() if keeps else self._behind

    @property
    def backlog(self) -> int:
        return len(self._kept)

    def keeps_replies(self, station: "Speaker") -> bool:
        """Returns True while replies of the station, also older ones, wait for others."""
        return station in self._replies

    def flow(self) -> None:
        """Ends the stall."""
        self.stalled = False
        if self._kept:
            self._say_kept()
        else:
            self.lasting = False

    def buffer(self) -> None:
        self.buffering, self._draining = True, False

    def end_buffering(self) -> None:
        """Passes on what is kept, one request at a time, and then each at once."""
        self._draining = True
        self.buffering = bool(self._kept)

    def clear(self) -> None:
        self._kept.clear()
        self.buffering = self.buffering and not self._draining
        self._unread.clear()
        for replies in self._replies.values():
            replies.clear()
        for requests in self._requests.values():
            requests.clear()

    def _say_kept(self) -> None:
        """Sends the kept requests one by one, and waits a while for each reply."""
        data, master = self._kept[0]
        ends = self._wire.say_request(data, _now(), master)
        self._turn += 1
        self._wire.at(ends + SERVER_WAITS, partial(self._next_kept, self._turn))

    def replies(self, end: float) -> None:
        """A station replies until then: a server that buffers sends its next request after it."""
        if self.buffering and self._kept:
            self._turn += 1
            self._wire.at(end + REST, partial(self._next_kept, self._turn))

    def _next_kept(self, turn: int) -> None:
        if turn != self._turn or not self._kept:
            return
        self._kept.popleft()
        if not self.buffering:
            self._behind = _now()
        if self._kept and not self.stalled:
            self._say_kept()
        elif not self._kept and not self.stalled:
            self.lasting = False
            self.buffering = self.buffering and not self._draining

    # Replies while no connection is open

    def unheard_piece(self, data: bytes) -> None:
        if self.lasting and not self._wire.hanging:
            self._unread.append(data)

    def opened(self) -> None:
        if self._unread:
            self._wire.at(_now(), self._pass_unread)

    def _pass_unread(self) -> None:
        unread, self._unread = b"".join(self._unread), []
        if unread:
            self._wire.deliver(unread)

    def pass_on(self, data: bytes) -> None:
        """Passes on a whole frame between those of the wire."""
        free = self._wire.free_at
        if self._wire.chunk and free > _now():
            self._wire.at(free + 1e-4, partial(self.pass_on, data))
        else:
            self._wire.deliver(data)

    # Stations that are held up

    def hold_replies(self, station: "Speaker") -> None:
        self._replies[station] = []

    def hold_requests(self, station: "Speaker") -> None:
        self._requests[station] = []

    def holds(self, sending: "Sending") -> bool:
        """Keeps the reply of a station that is held up."""
        return sending.station is not None and self._hold(sending.station, sending.data)

    def _hold(self, station: "Speaker", reply: bytes) -> bool:
        held = self._replies.get(station)
        if held is None:
            return False
        held.append(reply)
        return True

    def keeps_from(self, station: "Speaker", data: bytes, request: bytes) -> bool:
        """Keeps the request to a station that is held up."""
        held = self._requests.get(station)
        if held is None:
            return False
        held.append((data, request))
        return True

    def release(self, station: "Speaker", rest: float) -> None:
        """Passes on what was held, in order, with `rest` seconds between two frames."""
        self._rest = rest
        if station in self._replies:
            self._pass_held(station)
        if station in self._requests:
            self._ask_held(station)

    def _pass_held(self, station: "Speaker") -> None:
        held = self._replies.get(station)
        if not held:
            self._replies.pop(station, None)
            return
        data = held.pop(0)
        at = _now() + len(data) * self._wire.wire.character
        self._wire.at(at, partial(self.pass_on, data))
        self._wire.at(at + self._rest, partial(self._pass_held, station))

    def _ask_held(self, station: "Speaker") -> None:
        """The station gets the requests one by one, and replies to each."""
        self._behind = now = _now()
        held = self._requests.get(station)
        if not held:
            self._requests.pop(station, None)
            return
        character = self._wire.wire.character
        data, request = held.pop(0)
        said = station.hear(data, now)
        if said is not None and not request:
            self._wire.watch.answered(data, said[0])
        if said is None:  # that of another station takes no time of this one
            self._wire.at(now, partial(self._ask_held, station))
            return
        ends = now + len(data) * character
        if said[0]:
            ends = now + said[1] + len(said[0]) * character
            self._wire.at(ends, partial(self._pass_late, station, said[0]))
        self._wire.at(ends + self._rest, partial(self._ask_held, station))

    def _pass_late(self, station: "Speaker", reply: bytes) -> None:
        """Passes on the reply to a kept request; its replies may be held up again meanwhile."""
        if not self._hold(station, reply):
            self.pass_on(reply)


def _now() -> float:
    return asyncio.get_running_loop().time()
