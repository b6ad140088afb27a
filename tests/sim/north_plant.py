"""Draws the plant, the network and the faults of a seed at the northbound edge."""

import json
import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from gateway.protocols.driver import AnyDriver
from gateway.stations.registry import station_of
from gateway.stations.station import Station
from gateway.tags import Tag

REFRESHES = (20.0, 60.0, 600.0, 600.0)
RATES = (8_000.0, 8_000.0, 16_000.0, 125_000.0, 500_000.0, 10_000_000.0)  # bytes per second
LATENCIES = (0.0002, 0.005, 0.04, 0.3)
STORM, QUIET = 60.0, 90.0  # seconds
# Seconds between two values of a tag. In a calm plant the links are not full all the time.
BUSY, CALM = (0.5, 3.0, 20.0, 90.0, 400.0), (90.0, 90.0, 400.0)


class Fault(NamedTuple):
    """Something that happens. Times in seconds from the start."""

    start: float
    end: float
    kind: str
    target: str  # a client, router or device


class Place(NamedTuple):
    """A client or router of the network."""

    rate: float
    latency: float
    buffer: int  # bytes that the system takes beside Zenoh's queues
    at: str  # its router; empty: the gateway


@dataclass(frozen=True)
class Drawn:
    """All that a seed determines beforehand."""

    document: dict[str, Any]
    routers: dict[str, Place]
    viewers: dict[str, Place]
    people: dict[str, Place]
    faults: tuple[Fault, ...]
    refresh: float
    steps: tuple[float, ...]
    phase: float | None  # tags of one step change at the same time


def draw(seed: int, seconds: float, calm: float, folder: Path) -> Drawn:
    chance = random.Random(f"north {seed}")
    refresh = chance.choice(REFRESHES)
    lines = {f"line{n}": _line(n, chance) for n in range(chance.choice((1, 1, 2)))}
    keep = chance.choice((60.0, 120.0, 2 * (seconds + calm), 20 * (seconds + calm)))
    port = 1024 + os.getpid() % 60_000  # one process has it: no other session is opened
    (folder / "zenoh.json5").write_text(json.dumps(_transport(chance)))
    document = {
        "gateway": {"name": "sim"},
        "zenoh": {
            "listen": [f"tcp/127.0.0.1:{port}"],
            "refresh": f"{refresh:g}s",
            "config_file": str(folder / "zenoh.json5"),
        },
        "history": {
            "path": str(folder / "history.db"),
            "keep": f"{keep:.0f}s",
            "max_size": chance.choice(("8MB", "64MB")),
        },
        "lines": lines,
    }
    routers = {"router": _place(chance, "")} if chance.random() < 0.5 else {}
    viewers = {f"viewer{n}": _place(chance, _at(chance, routers)) for n in range(3)}
    people = {name: _place(chance, _at(chance, routers)) for name in ("asker", "reader", "writer")}
    everybody = [*routers, *viewers, *people]
    faults = _faults(everybody, ("stall", "cut", "cut", "flap", "narrow"), chance, seconds, 15.0)
    faults += _faults(["asker", "reader", "writer"], ("leave",), chance, seconds, 15.0)
    more = random.Random(f"more {seed}")
    faults += _faults(["gateway"], ("restart",), more, seconds, 60.0)
    faults += _faults(list(people), ("flood",), more, seconds, 60.0)
    devices = [name for line in lines.values() for name in line["devices"]]
    faults += _faults(devices, ("deaf", "mute", "slow", "slow"), chance, seconds, 15.0)
    return Drawn(
        *(document, routers, viewers, people, tuple(sorted(faults)), refresh),
        steps=chance.choice((BUSY, CALM, CALM)),
        phase=chance.choice((chance.random(), chance.random(), None)),
    )


def _transport(chance: random.Random) -> dict[str, Any]:
    """Settings of the user: smaller queues are full sooner."""
    batch, low = chance.choice(((8192, 16), (8192, 1), (2048, 4), (2048, 1)))
    drop = chance.choice((10_000, 50_000))
    queue = {
        "size": {"data_low": low},
        "congestion_control": {"drop": {"wait_before_drop": drop}},
    }
    return {"transport": {"link": {"tx": {"batch_size": batch, "queue": queue}}}}


def _at(chance: random.Random, routers: dict[str, Place]) -> str:
    return "router" if routers and chance.random() < 0.4 else ""


def _place(chance: random.Random, at: str) -> Place:
    return Place(chance.choice(RATES), chance.choice(LATENCIES), chance.choice((2048, 16_384)), at)


def _faults(
    targets: list[str],
    kinds: tuple[str, ...],
    chance: random.Random,
    seconds: float,
    every: float,
) -> list[Fault]:
    """Draws a storm of a minute, then a time in which all must become right, and so on."""
    lengths = {
        "stall": 2.5,
        "cut": 40.0,
        "leave": 6.0,
        "flap": 20.0,
        "narrow": 30.0,
        "restart": 3.0,
    }
    found = []
    stormy = chance.expovariate(1 / every)
    while (at := stormy // STORM * (STORM + QUIET) + stormy % STORM) < seconds:
        kind = chance.choice(kinds)
        longest = lengths.get(kind, 30.0)
        end = min(seconds, at + chance.uniform(0.05, longest))
        found.append(Fault(at, end, kind, chance.choice(targets)))
        stormy += chance.expovariate(1 / every)
    return found


def _line(number: int, chance: random.Random) -> dict[str, Any]:
    devices = {f"d{number}{n}": _device(n + 1, chance) for n in range(chance.choice((1, 2, 3)))}
    return {"port": "simulator", "baudrate": 19200, "format": "8E1", "devices": devices}


def _device(station: int, chance: random.Random) -> dict[str, Any]:
    tags: dict[str, Any] = {}
    for group in range(chance.choice((1, 2))):
        every = chance.choice(("500ms", "1s", "2s"))
        history = chance.random() < 0.7
        for n in range(chance.choice((5, 20, 60, 120))):
            address = 200 * group + n
            tags[f"v{address}"] = {
                "address": f"holding:{address}",
                "every": every,
                "history": history,
            }
    for n in range(3):
        rule: Any = chance.choice((True, True, {"verify": True}))
        tags[f"w{n}"] = {
            "address": f"holding:{900 + n}",
            "every": "1s",
            "write": rule,
            "history": True,
        }
    blocks = chance.choice((False, False, True, "only"))
    return {
        "protocol": "modbus-rtu",
        "station": station,
        "reply_timeout": "200ms",
        "blocks": blocks,
        "tags": tags,
    }


class Slave:
    """A station whose values move in steps. `executed` gets each written tag and value."""

    def __init__(
        self,
        driver: AnyDriver,
        tags: list[Tag],
        chance: random.Random,
        drawn: Drawn,
        executed: Callable[[str, int], None],
    ) -> None:
        self.inner: Station = station_of(driver)
        self.deaf = 0
        self.mute = 0
        self.slow = 0
        self._executed = executed
        self._writable = {tag.span.start: tag.key for tag in tags if tag.write is not None}
        memory = self.inner.memory
        for tag in tags:
            if tag.write is None:
                memory.animate(tag.span.area, tag.span.start, _steps(drawn, chance))
        plain = memory.write

        def write(area: str, start: int, values: Any) -> None:
            values = list(values)
            plain(area, start, values)
            for n, value in enumerate(values):
                if start + n in self._writable:
                    self._executed(self._writable[start + n], value)

        memory.write = write  # type: ignore[method-assign]  # the only place to observe writes

    @property
    def memory(self) -> Any:
        return self.inner.memory

    @property
    def delay(self) -> float:
        return 0.15 if self.slow else 0.0

    def hear(self, data: bytes, now: float) -> list[bytes]:
        if self.deaf:
            return []
        replies = self.inner.hear(data, now)
        return [] if self.mute else replies


def _steps(drawn: Drawn, chance: random.Random) -> Callable[[float], int]:
    """Returns a value that stays for a while; equal ones are far apart."""
    every, phase, own = chance.choice(drawn.steps), chance.random(), chance.randrange(60_000)
    if drawn.phase is not None:
        phase = drawn.phase
    return lambda now: (int(now / every + phase) * 7919 + own) % 65_521
