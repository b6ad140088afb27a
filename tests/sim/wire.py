"""A half-duplex wire with faults: collisions, bit errors, parity, lost ports.

Its ends are the port of the gateway and the stations. Every event has an exact time of the loop's
clock, and all chance comes from one `random.Random`.
"""

import asyncio
import math
import random
from collections.abc import Callable, Sequence
from contextvars import copy_context
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.transport import Receiver
from tests.sim.noise import Format, Noise, spoil
from tests.sim.server import DeviceServer


class Speaker(Protocol):
    """A station with its faults: its replies, each with its delay after the request."""

    def hear(self, data: bytes, now: float) -> tuple[bytes, float] | None: ...

    def copies(self) -> list[tuple[float, bool]]:
        """Returns the copies of its last reply: seconds after it, and if they are on the wire."""

    @property
    def listens_after(self) -> float:
        """Seconds after any reply for which it does not listen."""

    @property
    def drives_for(self) -> float:
        """Seconds after its own reply for which it damages the characters of others."""


class Master:
    """Another master. It only asks; the replies reach every master."""

    listens_after = drives_for = 0.0

    def hear(self, data: bytes, now: float) -> None: ...

    def copies(self) -> list[tuple[float, bool]]:
        return []


class Watch(Protocol):
    """Observes all traffic of a wire."""

    def sent(self, data: bytes, start: float, end: float) -> None:
        """The gateway begins to send."""

    def overlapped(self, station: Speaker | None) -> None:
        """The gateway and this station send at the same time."""

    def lost_by_silence(self, request: bytes, station: Speaker | None) -> None:
        """A station does not get the first characters, because they came too early. None: all."""

    def damaged(self, way: str) -> None:
        """Damaged bytes arrive at the stations (>) or at the gateway (<)."""

    def passed(self, way: str, data: bytes) -> None:
        """Bytes arrived."""

    def answered(self, request: bytes, reply: bytes) -> None:
        """A station replies to the gateway."""

    def repeated(self) -> None:
        """A reply will arrive a second time."""

    def answered_other(self, station: Speaker, request: bytes, reply: bytes) -> None:
        """A reply arrived that another master asked for, or that an unknown station sent."""


@dataclass(eq=False)
class Sending:
    """Bytes on the wire. `station`: None for the gateway."""

    start: float
    end: float
    data: bytes
    station: Speaker | None
    request: bytes = b""  # of another master, or answered by an unknown station
    spoilt: bool = False
    silence: float = math.inf  # seconds before it, after a reply
    after: Speaker | None = None  # which replied


@dataclass(eq=False)
class SimWire:
    """One line: the opener of its port, and its stations."""

    wire: WireTiming
    shape: Format
    stations: Sequence[Speaker]
    chance: random.Random
    watch: Watch
    echo: bool = False
    chunk: int = 0  # characters of one piece; 0: a whole reply
    noise: Noise = field(default_factory=Noise)
    gone: str = ""  # the reason why the port is lost
    hanging: bool = False  # no byte passes, and no error is reported
    hung: bool = False  # the same, until the port is opened again
    opened: int = 0
    closed: int = 0
    addressed: Callable[[bytes], Sequence[Speaker]] | None = (
        None  # the stations that a whole request is for
    )
    twins: list[Speaker] = field(default_factory=list)  # stations with the number of another

    def __post_init__(self) -> None:
        self._ear: Receiver | None = None
        self._generation = 0
        self._sendings: list[Sending] = []
        self._ours_until = 0.0
        self._replied: tuple[float, Speaker | None] = (-math.inf, None)  # until when, and who
        self._heard_until = -math.inf  # when the gateway heard a reply last
        self.server = DeviceServer(self)
        self._context = copy_context()  # the world's, also where the gateway sends

    # The port

    async def open(self, ear: Receiver) -> "SimWire":
        if self.gone:
            raise LineDown(self.gone)
        if self.hung:
            self.hung = self.hanging = False
        self._ear = ear
        if not self.server.lasting:
            self._generation += 1
        self.opened += 1
        self.server.opened()
        return self

    def write(self, data: bytes) -> None:
        if self._ear is None:
            raise LineDown(self.gone or "closed")
        start = max(now(), self._ours_until)
        self._ours_until = start + len(data) * self.wire.character
        self.watch.sent(data, start, self._ours_until)
        if not self.hanging:
            self.server.send(data, start)

    @property
    def behind(self) -> float:
        """The last time at which the device server had kept bytes."""
        return self.server.behind

    def say_request(self, data: bytes, start: float, master: Master | None) -> float:
        """Sends the request of the gateway, or of another master. Returns its end."""
        request = data if master is not None else b""
        end = start + len(data) * self.wire.character
        sending = Sending(start, end, data, master, request)
        sending.silence, sending.after = start - self._replied[0], self._replied[1]
        for other in self._collide(sending):
            if other.station is not None and master is None:
                self.watch.overlapped(other.station)
        self.at(sending.end, lambda: self._reach_stations(sending))
        if self.echo:
            self.at(sending.end, lambda: self._deliver(sending, sending.data))
        return sending.end

    async def close(self) -> None:
        self.closed += 1
        self._ear = None
        self._end()

    def vanish(self, why: str) -> None:
        self.gone = why
        self.reset(why)

    def reset(self, why: str) -> None:
        """Ends the connection; the next one can be opened at once."""
        ear, self._ear = self._ear, None
        self._end()
        if ear is not None:
            ear.lost(LineDown(why))

    def come_back(self) -> None:
        self.gone = ""

    def _end(self) -> None:
        if not self.server.lasting:
            self._generation += 1
            self.server.clear()

    # The wire

    def _collide(self, sending: Sending) -> list[Sending]:
        current = now()
        self._sendings = [other for other in self._sendings if other.end > current]
        least = 0.1 * self.wire.character
        hit = [
            other
            for other in self._sendings
            if other.start < sending.end - least and sending.start < other.end - least
        ]
        for other in hit:
            other.spoilt = sending.spoilt = True
        self._sendings.append(sending)
        return hit

    def _reach_stations(self, request: Sending) -> None:
        data = self._through(request, self._after_a_reply(request), ">")
        if not data or self.hanging:
            return
        if not request.request:
            self.watch.passed(">", data)
        # Without damage the other stations ignore the request; this saves their time.
        well = self.addressed is not None and data is request.data
        for station in self.addressed(data) if well and self.addressed else self.stations:
            early = self._early(station.listens_after, request)
            if early:
                self.watch.lost_by_silence(request.data, station)
            if not self.server.keeps_from(station, data, request.request):
                self.ask(station, data[early:], request.end, request.request)
        for station in self.twins:
            self.ask(station, data, request.end, data)

    def _after_a_reply(self, request: Sending) -> bytes:
        """Returns the request, damaged while the station that replied still drives the pair."""
        after = request.after
        early = 0 if after is None else self._early(after.drives_for, request)
        if not early:
            return request.data
        self.watch.lost_by_silence(request.data, None)
        self.watch.damaged(">")
        damaged = (self.chance.randrange(1 << self.shape.data_bits) for _ in request.data[:early])
        return bytes(damaged) + request.data[early:]

    def _early(self, needed: float, request: Sending) -> int:
        """Returns the number of its characters that are sent before so many seconds of silence."""
        missing = needed - request.silence - 1e-6
        return math.ceil(missing / self.wire.character) if 0.0 < missing <= needed else 0

    def silence_at(self, start: float) -> float:
        """Returns the seconds of silence before a request, after a reply that the gateway heard."""
        return start - self._heard_until

    def ask(self, station: Speaker, data: bytes, end: float, request: bytes) -> None:
        """The request, which ended at `end`, reaches the station."""
        said = station.hear(data, end)
        if said is None or not said[0]:
            return
        if not request:
            self.watch.answered(data, said[0])
        self._say(said[0], end + said[1], station, request)
        for after, on_wire in station.copies():
            self.watch.repeated()
            start = end + said[1] + len(said[0]) * self.wire.character + after
            if on_wire:
                self._say(said[0], start, station)
            else:
                self.at(start, partial(self.server.pass_on, said[0]))

    def speak(self, data: bytes, station: Speaker) -> None:
        """The station sends this now, with or without a request."""
        if not self.hanging:
            self._say(data, now(), station)

    def _say(self, data: bytes, start: float, station: Speaker, request: bytes = b"") -> None:
        end = start + len(data) * self.wire.character
        sending = Sending(start, end, data, station, request)
        if start <= now():
            self._begin(sending)
        else:
            loop = asyncio.get_running_loop()
            loop.call_at(start, self._begin, sending, context=self._context)

    def _begin(self, sending: Sending) -> None:
        """Finds the collisions at the beginning of the bytes: earlier they are unknown."""
        for other in self._collide(sending):
            if other.station is None:
                self.watch.overlapped(sending.station)
        self._replied = max(
            self._replied, (sending.end, sending.station), key=lambda reply: reply[0]
        )
        self.server.replies(sending.end)
        if self.server.holds(sending):
            return
        chunk = self.chunk or len(sending.data)
        for first in range(0, len(sending.data), chunk):
            piece = sending.data[first : first + chunk]
            due = sending.start + (first + len(piece)) * self.wire.character
            self.at(due, partial(self._deliver, sending, piece))

    def _deliver(self, sending: Sending, piece: bytes) -> None:
        if self._ear is None or self.hanging:
            self.server.unheard_piece(piece)
            return
        data = self._through(sending, piece, "<")
        if data:
            self.watch.passed("<", data)
            if sending.request and sending.station is not None and sending.data.endswith(data):
                self.watch.answered_other(sending.station, sending.request, sending.data)
            self._heard_until = now()  # the last characters may have been lost
            self._ear.received(data)

    @property
    def free_at(self) -> float:
        """The time from which no station sends."""
        return max((s.end for s in self._sendings if s.station is not None), default=0.0)

    def deliver(self, data: bytes) -> None:
        """Passes bytes to the gateway that were not on the wire just now."""
        if self._ear is None or self.hanging:
            self.server.unheard_piece(data)
            return
        self.watch.passed("<", data)
        self._ear.received(data)

    def _through(self, sending: Sending, data: bytes, way: str) -> bytes:
        """Returns the bytes that arrive."""
        heard = data
        if sending.spoilt:
            heard = bytes(self.chance.randrange(1 << self.shape.data_bits) for _ in data)
        if self.noise.before or self.noise.after:
            heard = spoil(heard, self.noise, self.shape, self.chance)
        if heard != data:
            self.watch.damaged(way)
        return heard

    def at(self, due: float, then: Callable[[], None]) -> None:
        generation = self._generation

        def unless_closed() -> None:
            if generation == self._generation:
                then()

        loop = asyncio.get_running_loop()
        if due <= loop.time():
            loop.call_soon(unless_closed, context=self._context)
        else:
            loop.call_at(due, unless_closed, context=self._context)


def now() -> float:
    return asyncio.get_running_loop().time()
