"""A half-duplex wire that is never quite well: collisions, bit errors, parity, lost ports.

Two ends: the gateway's port, and stations that speak when spoken to. All of it happens at exact
moments of the loop's clock, and all chance comes from one `random.Random`.
"""

import asyncio
import math
import random
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.transport import Receiver

SERVER_WAITS = 0.25  # seconds between two requests that it has kept


class Speaker(Protocol):
    """A station with its faults: what it says, and how long after the request."""

    def hear(self, data: bytes, now: float) -> tuple[bytes, float] | None: ...


class Watch(Protocol):
    """Observes all bytes on the wire."""

    def sent(self, data: bytes, start: float, end: float) -> None:
        """The gateway begins to speak."""

    def overlapped(self, station: Speaker | None) -> None:
        """The gateway and this station speak at once."""

    def damaged(self, way: str) -> None:
        """Not what was sent arrives at the stations (>) or at the gateway (<)."""

    def passed(self, way: str, data: bytes) -> None:
        """Arrived."""


@dataclass
class Noise:
    """Bit errors. `before`: before the receiver looks at the parity; `after`: later on."""

    before: float = 0.0
    after: float = 0.0


@dataclass
class Format:
    """A character on the wire, as in `7E1`, and what its receiver makes of a broken one."""

    data_bits: int = 8
    parity: bool = False
    stop_bits: int = 1
    broken_as_zero: bool = False  # otherwise it is dropped

    @property
    def bits(self) -> int:
        return 1 + self.data_bits + self.parity + self.stop_bits


@dataclass(eq=False)
class _Sending:
    start: float
    end: float
    data: bytes
    station: Speaker | None  # None: the gateway
    spoilt: bool = False


@dataclass(eq=False)
class SimWire:
    """One line: the opener of its port, and its stations."""

    wire: WireTiming
    shape: Format
    stations: Sequence[Speaker]
    chance: random.Random
    watch: Watch
    echo: bool = False
    chunk: int = 0  # characters told at once; 0: a whole reply
    noise: Noise = field(default_factory=Noise)
    gone: str = ""  # why the port is not there
    hanging: bool = False  # nothing passes, and nobody is told
    stalled: bool = False  # the device server keeps what is said, and says it later, in order
    opened: int = 0
    closed: int = 0
    addressed: Callable[[bytes], Sequence[Speaker]] | None = None  # whom a whole request is for

    def __post_init__(self) -> None:
        self._ear: Receiver | None = None
        self._generation = 0
        self._sendings: list[_Sending] = []
        self._ours_until = 0.0
        self._kept: deque[bytes] = deque()  # the first is being said
        self._behind = -math.inf

    # The port

    async def open(self, ear: Receiver) -> "SimWire":
        if self.gone:
            raise LineDown(self.gone)
        self._ear = ear
        self._generation += 1
        self.opened += 1
        return self

    def write(self, data: bytes) -> None:
        if self._ear is None:
            raise LineDown(self.gone or "closed")
        start = max(_now(), self._ours_until)
        self._ours_until = start + len(data) * self.wire.character
        self.watch.sent(data, start, self._ours_until)
        if self.hanging:
            return
        if self.stalled or self._kept:
            self._kept.append(data)
        else:
            self._say_ours(data, start)

    @property
    def behind(self) -> float:
        """The last time at which the device server still had bytes to send."""
        return _now() if self.stalled or self._kept else self._behind

    def flow(self) -> None:
        """The stall is over."""
        self.stalled = False
        if self._kept:
            self._say_kept()

    def _say_kept(self) -> None:
        """One after the other, and each answer is waited for a while."""
        ends = self._say_ours(self._kept[0], _now())
        self._at(ends + SERVER_WAITS, self._next_kept)

    def _next_kept(self) -> None:
        self._kept.popleft()
        self._behind = _now()
        if self._kept and not self.stalled:
            self._say_kept()

    def _say_ours(self, data: bytes, start: float) -> float:
        sending = _Sending(start, start + len(data) * self.wire.character, data, None)
        for other in self._collide(sending):
            if other.station is not None:
                self.watch.overlapped(other.station)
        self._at(sending.end, lambda: self._reach_stations(sending))
        if self.echo:
            self._at(sending.end, lambda: self._deliver(sending, sending.data))
        return sending.end

    async def close(self) -> None:
        self.closed += 1
        self._ear = None
        self._end()

    def vanish(self, why: str) -> None:
        self.gone = why
        ear, self._ear = self._ear, None
        self._end()
        if ear is not None:
            ear.lost(LineDown(why))

    def come_back(self) -> None:
        self.gone = ""

    def _end(self) -> None:
        self._generation += 1
        self._kept.clear()

    # The wire

    def _collide(self, sending: _Sending) -> list[_Sending]:
        now = _now()
        self._sendings = [other for other in self._sendings if other.end > now]
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

    def _reach_stations(self, request: _Sending) -> None:
        data = self._through(request, request.data, ">")
        if not data or self.hanging:
            return
        self.watch.passed(">", data)
        # Where all is well the others would only look away: what they do with it takes long.
        well = self.addressed is not None and data is request.data
        for station in self.addressed(data) if well and self.addressed else self.stations:
            said = station.hear(data, request.end)
            if said is not None and said[0]:
                self._say(said[0], request.end + said[1], station)

    def speak(self, data: bytes, station: Speaker) -> None:
        """The station says this now, whether anybody asked or not."""
        if not self.hanging:
            self._say(data, _now(), station)

    def _say(self, data: bytes, start: float, station: Speaker) -> None:
        sending = _Sending(start, start + len(data) * self.wire.character, data, station)
        if start <= _now():
            self._begin(sending)
        else:
            asyncio.get_running_loop().call_at(start, self._begin, sending)

    def _begin(self, sending: _Sending) -> None:
        """Not before it begins is it known whom it collides with."""
        for other in self._collide(sending):
            if other.station is None:
                self.watch.overlapped(sending.station)
        chunk = self.chunk or len(sending.data)
        for first in range(0, len(sending.data), chunk):
            piece = sending.data[first : first + chunk]
            due = sending.start + (first + len(piece)) * self.wire.character
            self._at(due, partial(self._deliver, sending, piece))

    def _deliver(self, sending: _Sending, piece: bytes) -> None:
        if self._ear is None or self.hanging:
            return
        data = self._through(sending, piece, "<")
        if data:
            self.watch.passed("<", data)
            self._ear.received(data)

    def _through(self, sending: _Sending, data: bytes, way: str) -> bytes:
        """Returns the bytes that arrive."""
        heard = data
        if sending.spoilt:
            heard = bytes(self.chance.randrange(1 << self.shape.data_bits) for _ in data)
        if self.noise.before or self.noise.after:
            heard = spoil(heard, self.noise, self.shape, self.chance)
        if heard != data:
            self.watch.damaged(way)
        return heard

    def _at(self, due: float, then: Callable[[], None]) -> None:
        generation = self._generation

        def unless_closed() -> None:
            if generation == self._generation:
                then()

        loop = asyncio.get_running_loop()
        if due <= loop.time():
            loop.call_soon(unless_closed)
        else:
            loop.call_at(due, unless_closed)


def spoil(data: bytes, noise: Noise, shape: Format, chance: random.Random) -> bytes:
    """Bit errors of both kinds; start, parity and stop bits are hit as well."""
    if noise.before:
        data = strike(data, flips(len(data) * shape.bits, noise.before, chance), shape)
    out: list[int] = list(data)
    if noise.after:
        for bit in flips(len(out) * shape.data_bits, noise.after, chance):
            out[bit // shape.data_bits] ^= 1 << bit % shape.data_bits
    return bytes(out)


def strike(data: bytes, bits: Iterable[int], shape: Format) -> bytes:
    """Returns the bytes received when these bits turn, counted from the first start bit."""
    masks: dict[int, int] = {}
    for bit in bits:
        masks[bit // shape.bits] = masks.get(bit // shape.bits, 0) | 1 << bit % shape.bits
    out: list[int] = list(data)
    for place, mask in sorted(masks.items(), reverse=True):
        _break(out, place, mask, shape)
    return bytes(out)


def _break(out: list[int], place: int, mask: int, shape: Format) -> None:
    """One character with these bits turned: bit 0 is the start bit, then data, parity, stop."""
    framed = mask & 1 or mask >> (1 + shape.data_bits + shape.parity)
    data = mask >> 1 & ((1 << shape.data_bits) - 1)
    parity = mask >> (1 + shape.data_bits) & 1 if shape.parity else 0
    odd = shape.parity and (data.bit_count() + parity) % 2
    if not framed and not odd:
        out[place] ^= data
    elif shape.broken_as_zero:
        out[place] = 0
    else:
        del out[place]


def flips(bits: int, rate: float, chance: random.Random) -> list[int]:
    """The numbers of the bits that turn."""
    found = []
    scale = math.log1p(-rate)
    place = int(math.log(1.0 - chance.random()) / scale)
    while place < bits:
        found.append(place)
        place += 1 + int(math.log(1.0 - chance.random()) / scale)
    return found


def _now() -> float:
    return asyncio.get_running_loop().time()
