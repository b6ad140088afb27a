"""Begins and ends what other parties do to a line (`hostile.py` draws it)."""

import asyncio
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from tests.sim.bus import Bus
from tests.sim.episodes import Episode
from tests.sim.freezer import Freezer
from tests.sim.manners import OTHERS, USUAL
from tests.sim.stations import Troubled
from tests.sim.wire import Master, SimWire

POURED, PIECE = 20, 0.02  # times the baud rate; seconds between two pieces
BESIDE = 0.7  # share of its questions that another master asks just after the gateway
MOST_WAITING = 8  # requests in the server; another master waits meanwhile


@dataclass(eq=False)
class Parties:
    """Other masters, other stations, and the device server between them and the gateway."""

    seed: int
    lines: Mapping[str, Bus]
    stations: Mapping[str, Troubled]  # by device
    make_twin: Callable[[str], Troubled]  # of a device
    freezer: Freezer
    _tasks: dict[Episode, asyncio.Task[None]] = field(default_factory=dict)
    _twins: dict[str, Troubled] = field(default_factory=dict)

    def begin(self, episode: Episode) -> None:
        wire = self.lines[episode.line].wire
        station = self.stations.get(episode.device)
        match episode.kind, station:
            case "frozen", _:
                self.freezer.freeze()
            case "hung", _:
                wire.hanging = wire.hung = True
            case "twice", Troubled():
                station.twice = episode.strength
            case "refusing", Troubled():
                station.refusing = self._code(station, episode)
            case _ if isinstance(wire, SimWire):
                self._begin(episode, wire, station)

    def _begin(self, episode: Episode, wire: SimWire, station: Troubled | None) -> None:
        match episode.kind, station:
            case "reset", _:
                wire.server.stalled = wire.server.lasting = True
            case "buffering", _:
                wire.server.buffer()
            case "master", _:
                master = OtherMaster(
                    self.lines[episode.line], wire, self._chance(episode), episode.strength
                )
                self._tasks[episode] = asyncio.create_task(master.ask_now_and_then())
            case "pour", _:
                bus = self.lines[episode.line]
                pouring = pour(bus, wire, self._chance(episode), episode.strength < 0.3)
                self._tasks[episode] = asyncio.create_task(pouring)
            case "twin", Troubled():
                if episode.device not in self._twins:
                    self._twins[episode.device] = self.make_twin(episode.device)
                wire.twins.append(self._twins[episode.device])
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
        match episode.kind, station:
            case "frozen", _:
                self.freezer.thaw()
            case "twice", Troubled():
                station.twice = 0.0
            case "refusing", Troubled():
                station.refusing = ""
            case _ if isinstance(wire, SimWire):
                self._end(episode, wire, station)

    def _end(self, episode: Episode, wire: SimWire, station: Troubled | None) -> None:
        match episode.kind, station:
            case "reset", _:
                wire.server.flow()
            case "buffering", _:
                wire.server.end_buffering()
            case (("master" | "pour"), _):
                self._tasks.pop(episode).cancel()
            case "twin", _ if episode.device in self._twins:
                wire.twins.remove(self._twins[episode.device])
            case (("held-replies" | "held-requests"), Troubled()):
                wire.server.release(station, 0.3 * episode.strength**2)

    def _chance(self, episode: Episode) -> random.Random:
        return random.Random(f"party {self.seed} {episode}")

    def _code(self, station: Troubled, episode: Episode) -> str:
        """Returns the code with which the station refuses everything for a while."""
        family = next((name for name in USUAL if station.protocol.startswith(name)), "")
        codes = (USUAL.get(family, ""), *OTHERS.get(family, ()))
        return self._chance(episode).choice(codes)


async def pour(bus: Bus, wire: SimWire, chance: random.Random, old: bool) -> None:
    """Pours bytes into the line, many times faster than its baud rate allows.

    `old`: replies of its stations, again and again; otherwise any bytes.
    """
    size = round(POURED * PIECE / wire.wire.character)
    while True:
        await asyncio.sleep(PIECE)
        said = [station.last for station in bus.stations.values() if station.last]
        if old and said:
            wire.deliver(chance.choice(said) * 5)
        else:
            bus.damaged("<")
            wire.deliver(chance.randbytes(size))


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
        server, pause = self.wire.server, 0.1 / self.strength
        server.buffer()
        try:
            while True:
                await asyncio.sleep(self.chance.expovariate(1 / pause))
                foreign = self.bus.foreign
                if self.chance.random() < BESIDE:
                    foreign.asks.clear()
                    await foreign.asks.wait()
                reads = foreign.reads
                if reads and server.backlog < MOST_WAITING and not self.wire.hanging:
                    server.send(self.chance.choice(reads), self.bus.now(), self)
        finally:
            server.end_buffering()
