"""A station with faults, and the port between a line and its simulated wire."""

import asyncio
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from gateway.errors import LineDown
from gateway.planning.wire_timing import WireTiming
from gateway.simulator.port import open_simulator
from gateway.stations.station import Memory
from gateway.stations.vigor import VigorStation
from gateway.transport import Port, Receiver

WIRE = WireTiming(19200, 10)
TURNAROUND = 0.005


@dataclass
class Unruly:
    """A station with faults. Its replies keep their order, as those of a PLC do."""

    inner: VigorStation
    seed: int = 0
    late: Callable[[random.Random], float] = lambda _: 0.0  # seconds on top, drawn for each reply
    delay: float = 0.0  # which the simulated wire adds to the turnaround
    listens_after: float = 0.0  # seconds after a reply in which it does not listen
    lose: float = 0.0  # share of replies that are lost
    cut: float = 0.0  # share of replies that break off
    wire: WireTiming = WIRE
    # Replies instead of `inner`, to the request and at the time it gets.
    answer: Callable[[bytes, float], list[bytes]] | None = None
    heard: list[tuple[float, bytes]] = field(default_factory=list)  # its requests
    lost: int = 0

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)
        self._until = 0.0

    @property
    def memory(self) -> Memory:
        return self.inner.memory

    @property
    def mute(self) -> bool:
        return self.inner.mute

    @mute.setter
    def mute(self, mute: bool) -> None:
        self.inner.mute = mute

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if data[1:3] == b"%02X" % self.inner.station:
            self.heard.append((now, data))
        replies = (self.answer or self.inner.hear)(data, now)
        if not replies:
            return []
        if self._random.random() < self.lose:
            self.lost += 1
            return []
        if self._random.random() < self.cut:
            replies = [reply[: self._random.randrange(1, len(reply))] for reply in replies]
        self.delay = max(self.late(self._random), self._until - now)
        length = sum(map(len, replies)) * self.wire.character
        self._until = now + self.delay + length + TURNAROUND
        return replies


@dataclass
class Bench:
    """The port between line and wire, and the bytes that passed through it."""

    noise: float = 0.0  # share of bytes with one bit turned, both ways
    echo: bool = False  # a two-wire adapter: what is sent comes back
    before_echo: bytes = b""  # bytes that its switching adds
    gone: str = ""  # the reason why the port is lost
    seed: int = 0
    opened: list[float] = field(default_factory=list)  # every try
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    damaged: int = 0
    ear: Receiver | None = None
    inner: Port | None = None

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    async def open(self, stations: Sequence[Any], wire: WireTiming, ear: Receiver) -> "Bench":
        self.opened.append(_now())
        if self.gone:
            raise LineDown(self.gone)
        self.ear = ear
        self.inner = await open_simulator(stations, wire, self, turnaround=TURNAROUND)
        return self

    def write(self, data: bytes) -> None:
        if self.gone or self.inner is None:
            raise LineDown(self.gone or "closed")
        self.sent.append((_now(), data))
        if self.echo:
            arrives = _now() + len(data) * WIRE.character
            asyncio.get_running_loop().call_at(arrives, self.received, self.before_echo + data)
        self.inner.write(self._spoil(data))

    async def close(self) -> None:
        if self.inner is not None:
            await self.inner.close()
            self.inner = None

    def received(self, data: bytes) -> None:
        if self.ear is not None and self.inner is not None:
            self.ear.received(self._spoil(data))

    def lost(self, error: Exception) -> None:
        raise AssertionError("the simulator is never lost by itself")

    def vanish(self, why: str = "unplugged") -> None:
        self.gone = why
        if self.ear is not None:
            self.ear.lost(LineDown(why))

    def come_back(self) -> None:
        self.gone = ""

    def _spoil(self, data: bytes) -> bytes:
        if not self.noise:
            return data
        spoilt = bytearray(data)
        for i in range(len(spoilt)):
            if self._random.random() < self.noise:
                spoilt[i] ^= 1 << self._random.randrange(7)
                self.damaged += 1
        return bytes(spoilt)


def _now() -> float:
    return asyncio.get_running_loop().time()
