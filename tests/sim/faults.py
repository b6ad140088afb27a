"""Begins and ends each fault at its time."""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from gateway.engine.device.device import Device
from gateway.stations.computer_link import ComputerLinkStation
from gateway.tags import Tag
from tests.sim.bus import Bus
from tests.sim.draw import Drawn
from tests.sim.episodes import Episode
from tests.sim.expect import Expectations
from tests.sim.hostile import PARTIES, resets
from tests.sim.judge import Judge
from tests.sim.noise import Noise
from tests.sim.parties import Parties
from tests.sim.stations import Troubled
from tests.sim.wire import SimWire

DEFAULT_TIMES = 0.5  # seconds, for a device without a poll


@dataclass(eq=False)
class Faults:
    """Begins and ends the episodes of a seed."""

    drawn: Drawn
    lines: Mapping[str, Bus]
    devices: Mapping[str, Device]
    tags: Mapping[str, Tag]  # by key
    judge: Judge
    expect: Expectations
    parties: Parties
    jump: Callable[[float], None]  # of the wall clock
    note: Callable[..., None]

    async def suffer(self) -> None:
        moments: list[tuple[float, int, str, Any]] = []
        for episode in self.drawn.episodes:
            moments.append((episode.start, len(moments), "begin", episode))
            moments.append((episode.end, len(moments), "end", episode))
            for reset in resets(episode):
                moments.append((reset, len(moments), "reset", episode))
        moments += [(at, -1, "jump", by) for at, by in self.drawn.jumps]
        for at, _, what, which in sorted(moments, key=lambda m: m[:3]):
            await asyncio.sleep(max(0.0, self.judge.began + at - self.judge.now))
            self.note(what, str(which))
            match what:
                case "jump":
                    self.jump(which)
                case "begin":
                    self._begin(which)
                case "end":
                    self._end(which)
                case "reset":
                    self.parties.reset(which)

    def _begin(self, episode: Episode) -> None:
        self.judge.story.counts[f"episode {episode.kind}"] += 1
        if episode.kind in PARTIES:
            self.parties.begin(episode)
            self.expect.bad(episode)
            return
        wire = self.lines[episode.line].wire
        match episode.kind:
            case "noise":
                wire.noise = Noise(before=episode.strength)
            case "noise-after":
                wire.noise = Noise(after=episode.strength)
            case "vanish" | "flicker":
                wire.vanish("unplugged")
            case "hang":
                wire.hanging = True
            case "stall" if isinstance(wire, SimWire):
                wire.server.stalled = True
            case "gone":
                tag = self.tags[f"{episode.device}/{episode.tag}"]
                self.judge.stations[episode.device].vanish(tag)
            case kind:
                station = self.judge.stations.get(episode.device)
                if station is not None:  # None for a device of broadcasts
                    self._trouble(station, episode, kind)
        self.expect.bad(episode)

    def _trouble(self, station: Troubled, episode: Episode, kind: str) -> None:
        device = self.devices.get(episode.device)
        timeout = device.timing.reply_timeout if device else DEFAULT_TIMES
        guard = device.settings.late_guard if device else DEFAULT_TIMES
        strength = episode.strength
        match kind:
            case "deaf":
                station.deaf = True
            case "reboot":
                station.deaf = True
                if isinstance(station.inner, ComputerLinkStation):
                    station.inner.link.forget_monitor()
            case "mute":
                station.mute = True
            case "lose" | "cut" | "foreign" | "junk":
                setattr(station, kind, strength)
            case "slow":
                station.late = lambda c: c.uniform(0.0, 0.9) * (timeout - station.turnaround)
            case "late":
                longest = max(0.0, timeout + 0.8 * guard - station.turnaround)
                station.late = lambda c: c.uniform(0.0, longest) if c.random() < strength else 0.0
            case "very-late":
                station.late = lambda c: c.uniform(0.0, 3.0) if c.random() < strength else 0.0

    def _end(self, episode: Episode) -> None:
        if episode.kind in PARTIES:
            self.parties.end(episode)
            self.expect.good(episode)
            return
        wire = self.lines[episode.line].wire
        match episode.kind:
            case "noise" | "noise-after":
                wire.noise = Noise()
            case "vanish" | "flicker":
                wire.come_back()
            case "hang":
                wire.hanging = False
            case "stall" if isinstance(wire, SimWire):
                wire.server.flow()
            case "gone":
                tag = self.tags[f"{episode.device}/{episode.tag}"]
                self.judge.stations[episode.device].come_back(tag)
            case _ if episode.device in self.judge.stations:
                self.judge.stations[episode.device].well()
        self.expect.good(episode)
