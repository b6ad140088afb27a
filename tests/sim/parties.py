"""Begins and ends what other parties do to a line (`hostile.py` draws it)."""

import asyncio
import random
from collections.abc import Mapping
from dataclasses import dataclass, field

from tests.sim.bus import Bus
from tests.sim.episodes import Episode
from tests.sim.stations import Troubled
from tests.sim.wire import Master, SimWire

MOST_WAITING = 8  # requests in the server; another master waits meanwhile


@dataclass(eq=False)
class Parties:
    """Other masters, other stations, and the device server between them and the gateway."""

    seed: int
    lines: Mapping[str, Bus]
    stations: Mapping[str, Troubled]  # by device
    _masters: dict[Episode, asyncio.Task[None]] = field(default_factory=dict)

    def begin(self, episode: Episode) -> None:
        wire = self.lines[episode.line].wire
        station = self.stations.get(episode.device)
        if station is not None and episode.kind == "twice":
            station.twice = episode.strength
        if not isinstance(wire, SimWire):
            return
        match episode.kind, station:
            case "reset", _:
                wire.server.stalled = wire.server.lasting = True
            case "buffering", _:
                wire.server.buffering = True
            case "master", _:
                chance = random.Random(f"master {self.seed} {episode}")
                master = OtherMaster(self.lines[episode.line], wire, chance, episode.strength)
                self._masters[episode] = asyncio.create_task(master.ask_now_and_then())
            case "held-replies", Troubled():
                wire.server.hold_replies(station)
            case "held-requests", Troubled():
                wire.server.hold_requests(station)

    def reset(self, episode: Episode) -> None:
        wire = self.lines[episode.line].wire
        if isinstance(wire, SimWire):
            wire.reset("connection reset by peer")

    def end(self, episode: Episode) -> None:
        wire = self.lines[episode.line].wire
        station = self.stations.get(episode.device)
        if station is not None and episode.kind == "twice":
            station.twice = 0.0
        if not isinstance(wire, SimWire):
            return
        match episode.kind, station:
            case "reset", _:
                wire.server.flow()
            case "buffering", _:
                wire.server.buffering = False
            case "master", _:
                self._masters.pop(episode).cancel()
            case (("held-replies" | "held-requests"), Troubled()):
                wire.server.release(station)


@dataclass(eq=False)
class OtherMaster(Master):
    """Another master behind the same device server. `strength`: how often it asks.

    It asks what the gateway asked before, at other times. Its replies reach the gateway too.
    """

    bus: Bus
    wire: SimWire
    chance: random.Random
    strength: float

    async def ask_now_and_then(self) -> None:
        server, pause = self.wire.server, 0.3 / self.strength
        server.buffering = True
        try:
            while True:
                await asyncio.sleep(self.chance.expovariate(1 / pause))
                reads = self.bus.foreign.reads
                if reads and server.backlog < MOST_WAITING and not self.wire.hanging:
                    server.send(self.chance.choice(reads), self.bus.now(), self)
        finally:
            server.buffering = False
