"""A simulated half-duplex wire with stations on it: characters take their time, and collide."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.stations.station import Station
from gateway.transport.port import Port, Receiver

# Two characters that overlap by less than this part of one leave each other whole: a UART looks at
# the middle of its bits, and a timer is never exact.
_UNNOTICED = 0.1
FIFO = 16  # characters that a UART gathers before it tells


async def open_simulator(
    stations: Sequence[Station],
    wire: WireTiming,
    ear: Receiver,
    *,
    turnaround: float = 0.005,
    paced: bool = True,
) -> Port:
    """Stations on a wire in memory. `turnaround`: seconds from request to reply.

    A station may take longer: `delay`, an attribute of it in seconds, is added. With
    `paced=False` nothing takes any time but that.
    """
    return SimulatedPort(HalfDuplex(stations, wire, ear.received, turnaround, paced=paced))


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
    """Characters of one sender on the wire between two moments."""

    start: float
    end: float
    data: bytes
    damaged: bytearray | None = None  # FF where somebody else was sending too

    def heard(self, first: int = 0, last: int | None = None) -> bytes:
        """What arrives of a piece of it; where two spoke at once, with all bits turned."""
        piece = self.data[first:last]
        if self.damaged is None:
            return piece
        return bytes(a ^ b for a, b in zip(piece, self.damaged[first:last], strict=True))

    def damage(self, start: float, end: float, character: float) -> None:
        """Somebody else is sending from `start` to `end`: every character touched is spoilt."""
        if self.damaged is None:
            self.damaged = bytearray(len(self.data))
        start += character * _UNNOTICED
        end -= character * _UNNOTICED
        for i in range(len(self.data)):
            begin = self.start + i * character
            if begin < end and start < begin + character:
                self.damaged[i] = 0xFF


class HalfDuplex:
    """The wire: the master's bytes to every station, their replies to `deliver`.

    All moments are reckoned from the moment of the request, not from when the loop came to it: a
    late loop delivers late, but the wire does not drift.
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
        self._master_until = 0.0  # the master's bytes follow each other, they do not collide

    def send(self, data: bytes) -> None:
        """The master puts bytes on the wire."""
        if self.cut or not data:
            return
        start = max(self._loop.time(), self._master_until)
        sending = self._put(data, start)
        self._master_until = sending.end
        self._at(sending.end, lambda: self._reach_stations(sending), self._loop.time())

    def close(self) -> None:
        """Nobody hears anything any more."""
        self.cut = True
        self._sendings.clear()

    def _put(self, data: bytes, start: float) -> _Sending:
        """Find out whom it collides with. What is over by now can collide with nothing."""
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
        data = request.heard()
        for station in self._stations:
            reply = b"".join(station.hear(data, request.end))
            if reply:
                delay: float = getattr(station, "delay", 0.0)
                self._reply(reply, request.end + self._turnaround + delay)

    def _reply(self, data: bytes, start: float) -> None:
        sending = self._put(data, start)
        chunk = FIFO if self._character else len(data)
        now = self._loop.time()  # one for all pieces: what is due overtakes what is not yet
        for first in range(0, len(data), chunk):
            self._deliver_later(sending, first, min(first + chunk, len(data)), now)

    def _deliver_later(self, sending: _Sending, first: int, last: int, now: float) -> None:
        due = sending.start + last * self._character
        self._at(due, lambda: self._deliver(sending.heard(first, last)), now)

    def _at(self, due: float, then: Callable[[], None], now: float) -> None:
        def unless_cut() -> None:
            if not self.cut:
                then()

        if due <= now:
            self._loop.call_soon(unless_cut)  # timers of one moment do not keep their order
        else:
            self._loop.call_at(due, unless_cut)
