"""A simulated half-duplex line with stations: characters take time, and collide."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.stations.station import Station
from gateway.transport.port import Port, Receiver

# An overlap of two characters by less than this part does no damage: a UART samples the middle of
# its bits, and a timer is never exact.
_UNNOTICED = 0.1
FIFO = 16  # characters that a UART collects before it reports them


async def open_simulator(
    stations: Sequence[Station],
    wire: WireTiming,
    receiver: Receiver,
    *,
    turnaround: float = 0.005,
    paced: bool = True,
) -> Port:
    """Opens a line in memory with stations. `turnaround`: seconds from request to reply.

    The attribute `delay` of a station, in seconds, is added. With `paced=False` only this delay
    takes time. A station with the attribute `listens_after` does not hear the characters of a
    request that come less than so many seconds after a reply.
    """
    return SimulatedPort(HalfDuplex(stations, wire, receiver.received, turnaround, paced=paced))


class SimulatedPort:
    def __init__(self, wire: "HalfDuplex") -> None:
        self._wire = wire

    def write(self, data: bytes) -> None:
        if self._wire.cut:
            raise LineDown("simulator: closed")
        self._wire.send(data)

    async def close(self) -> None:
        self._wire.close()


@dataclass(slots=True, eq=False)
class _Sending:
    """Characters of one sender on the line."""

    start: float
    end: float
    data: bytes
    damaged: bytearray | None = None  # FF where another sender collides

    def heard(self, first: int = 0, last: int | None = None) -> bytes:
        """Returns a piece as it is received: collisions invert all bits."""
        piece = self.data[first:last]
        if self.damaged is None:
            return piece
        return bytes(a ^ b for a, b in zip(piece, self.damaged[first:last], strict=True))

    def damage(self, start: float, end: float, character: float) -> None:
        """Damages the characters that another sender overlaps from `start` to `end`."""
        if self.damaged is None:
            self.damaged = bytearray(len(self.data))
        start += character * _UNNOTICED
        end -= character * _UNNOTICED
        for i in range(len(self.data)):
            begin = self.start + i * character
            if begin < end and start < begin + character:
                self.damaged[i] = 0xFF


class HalfDuplex:
    """The line: bytes of the master go to every station, their replies to `deliver`.

    All times count from the time of the request, not from the time of the callback: a late loop
    delivers late, but the line does not drift.
    """

    def __init__(
        self,
        stations: Sequence[Station],
        wire: WireTiming,
        deliver: Callable[[bytes], None],
        turnaround: float = 0.005,
        *,
        paced: bool = True,
    ) -> None:
        self.cut = False
        self._loop = asyncio.get_running_loop()
        self._stations = stations
        self._deliver = deliver
        self._character = wire.character if paced else 0.0
        self._turnaround = turnaround if paced else 0.0
        self._sendings: list[_Sending] = []
        self._master_until = 0.0  # bytes of the master follow each other, without collision
        self._replied_until = -math.inf

    def send(self, data: bytes) -> None:
        """Sends bytes of the master."""
        if self.cut or not data:
            return
        start = max(self._loop.time(), self._master_until)
        sending = self._put(data, start)
        self._master_until = sending.end
        self._at(sending.end, lambda: self._reach_stations(sending), self._loop.time())

    def close(self) -> None:
        """Ends all traffic."""
        self.cut = True
        self._sendings.clear()

    def _put(self, data: bytes, start: float) -> _Sending:
        """Adds a sending, and damages those that overlap it."""
        now = min(self._loop.time(), start)
        self._sendings = [other for other in self._sendings if other.end > now]
        sending = _Sending(start, start + len(data) * self._character, data)
        for other in self._sendings:
            if other.start < sending.end and sending.start < other.end:
                other.damage(sending.start, sending.end, self._character)
                sending.damage(other.start, other.end, self._character)
        self._sendings.append(sending)
        return sending

    def _reach_stations(self, request: _Sending) -> None:
        data, silence = request.heard(), request.start - self._replied_until
        for station in self._stations:
            needed: float = getattr(station, "listens_after", 0.0)
            early = 0
            if 0.0 <= silence < needed and self._character:
                early = math.ceil((needed - silence) / self._character)
            reply = b"".join(station.hear(data[early:], request.end))
            if reply:
                delay: float = getattr(station, "delay", 0.0)
                self._reply(reply, request.end + self._turnaround + delay)

    def _reply(self, data: bytes, start: float) -> None:
        sending = self._put(data, start)
        self._replied_until = max(self._replied_until, sending.end)
        chunk = FIFO if self._character else len(data)
        ends = [min(first + chunk, len(data)) for first in range(0, len(data), chunk)]
        pieces = iter(zip([0, *ends], ends, strict=False))

        def deliver_next() -> None:
            # The timers of uvloop count milliseconds and do not keep their order.
            self._deliver(sending.heard(*next(pieces)))

        now = self._loop.time()
        for end in ends:
            self._at(sending.start + end * self._character, deliver_next, now)

    def _at(self, due: float, then: Callable[[], None], now: float) -> None:
        def unless_cut() -> None:
            if not self.cut:
                then()

        if due <= now:
            self._loop.call_soon(unless_cut)  # timers of one moment do not keep their order
        else:
            self._loop.call_at(due, unless_cut)
