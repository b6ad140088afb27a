"""A seed -> a plant: a configuration file, its wires, and what will go wrong with them when."""

import json
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PROTOCOLS = ("vigor", "computer-link", "modbus-rtu", "modbus-ascii")
# How often tags are read: `busy` fills the wires, `lean` leaves time for many hours.
PACES = {
    "busy": ("200ms", "500ms", "1s", "1s", "2s", "2s", "5s", "10s"),
    "noisy": ("500ms", "1s"),  # storms of one kind only, below
    "late": ("500ms", "1s"),
    "tardy": ("500ms", "1s"),
    "storm": ("500ms", "1s", "2s"),  # ten times as much goes wrong
    "lean": ("20s", "30s", "60s", "60s"),
}
CALM = 1000.0  # seconds at the end in which nothing goes wrong


@dataclass(frozen=True)
class Episode:
    """One thing that goes wrong, for a while."""

    start: float
    end: float
    line: str
    device: str  # empty: the line
    kind: str
    strength: float

    @property
    def silent(self) -> bool:
        """Nothing of the device is heard meanwhile."""
        return self.kind in ("deaf", "mute", "vanish", "hang")


@dataclass(frozen=True)
class Drawn:
    """What the seed has chosen. Times in seconds from the start."""

    document: dict[str, Any]
    missing: dict[str, frozenset[int]]  # by device: addresses of its words that it refuses
    episodes: tuple[Episode, ...]
    jumps: tuple[tuple[float, float], ...]  # of the wall clock: when, by how many seconds
    chunks: dict[str, int]  # by line: characters that a UART gathers
    zeros: dict[str, bool]  # by line: a broken character is read as zero

    def write(self, folder: Path) -> Path:
        path = folder / "config.yaml"
        path.write_text(json.dumps(self.document))
        return path


def draw(seed: int, seconds: float, pace: str = "busy") -> Drawn:
    chance = random.Random(f"plant {seed}")
    lines: dict[str, Any] = {}
    missing: dict[str, frozenset[int]] = {}
    chunks, zeros = {}, {}
    episodes: list[Episode] = []
    for number in range(chance.choice((1, 1, 1, 2, 2, 3))):
        name = f"line{number}"
        lines[name] = _line(name, chance, missing, PACES[pace])
        chunks[name] = chance.choice((0, 0, 16, 16, 1) if pace == "busy" else (0, 0, 0, 16))
        zeros[name] = chance.random() < 0.5
        haste = 1.0 if pace in ("busy", "lean") else 0.1
        episodes += _line_episodes(name, lines[name], chance, seconds, haste, pace)
    jumps = []
    at = chance.expovariate(1 / 1800)
    while at < seconds:
        jumps.append((at, chance.choice((-7200.0, -3600.0, -1.0, 1.0, 3600.0, 1e6, -1e6))))
        at += chance.expovariate(1 / 1800)
    document = {
        "gateway": {"name": "demo"},
        "defaults": {"publish": chance.choice(("always", "always", "change"))},
        "lines": lines,
    }
    return Drawn(
        document, missing, tuple(sorted(episodes, key=_order)), tuple(jumps), chunks, zeros
    )


def _order(episode: Episode) -> tuple[float, str, str, str]:
    return episode.start, episode.line, episode.device, episode.kind


def _line(
    name: str,
    chance: random.Random,
    missing: dict[str, frozenset[int]],
    intervals: tuple[str, ...],
) -> dict[str, Any]:
    protocols = [chance.choice(PROTOCOLS)]
    if protocols[0] == "vigor" and chance.random() < 0.2:
        protocols.append("computer-link")
    rtu = protocols[0] == "modbus-rtu"
    line: dict[str, Any] = {
        "port": f"/dev/tty-{name}",
        "baudrate": chance.choice((9600, 19200, 19200, 38400)),
        "format": chance.choice(("8E1", "8N1", "8E1") if rtu else ("7E1", "7E1", "8N1", "8E1")),
        "echo": chance.random() < 0.15,
        "devices": {},
    }
    every = chance.choice(intervals)
    numbers = chance.sample(range(1, 32), chance.choice((1, 2, 2, 3, 4, 6)))
    for i, number in enumerate(numbers):
        device = f"{name}-{i}"
        protocol = protocols[i % len(protocols)]
        line["devices"][device] = _device(device, protocol, number, every, chance, missing)
    return line


def _device(
    name: str,
    protocol: str,
    number: int,
    every: str,
    chance: random.Random,
    missing: dict[str, frozenset[int]],
) -> dict[str, Any]:
    timeout = chance.choice((100, 200, 300, 500))
    device: dict[str, Any] = {
        "protocol": protocol,
        "station": number,
        "reply_timeout": f"{timeout}ms",
        "late_guard": f"{chance.choice((timeout, timeout, 2 * timeout))}ms",
        "retries": chance.choice((0, 1, 2, 2)),
        "defaults": {"every": every},
    }
    if protocol == "computer-link":
        device["frame_format"] = chance.choice((1, 4))
        device["monitor"] = chance.random() < 0.4
    if protocol.startswith("modbus"):
        device["diagnostics"] = chance.random() < 0.3
    if chance.random() < 0.05:
        device["enabled"] = False
    word, bit = ("holding:", "coil:") if protocol.startswith("modbus") else ("D", "M")
    first = chance.randrange(0, 400)
    tags: dict[str, Any] = {}
    for i in range(chance.randrange(2, 7)):
        address = first + i * chance.choice((1, 1, 2, 30))
        tags[f"v{address}"] = {"address": f"{word}{address}", "type": "uint16"}
    tags["long"] = {"address": f"{word}{first + 300}", "type": "uint32"}
    tags["scaled"] = {"address": f"{word}{first + 310}", "type": "uint16", "scale": 0.1}
    tags["flag"] = {"address": f"{bit}{chance.randrange(0, 200)}"}
    tags["bit"] = {"address": f"{word}{first + 320}.10"}
    tags["w0"] = {"address": f"{word}{first + 330}", "type": "uint16", "write": _rule(chance)}
    tags["w1"] = {"address": f"{word}{first + 332}", "type": "uint32", "write": _rule(chance)}
    tags["w2"] = {"address": f"{bit}{300 + chance.randrange(100)}", "write": _rule(chance)}
    tags["w3"] = {"address": f"{word}{first + 340}.3", "write": _rule(chance)}
    if chance.random() < 0.3:
        tags["slow"] = {"address": f"{word}{first + 311}", "type": "uint16", "every": "30s"}
    if chance.random() < 0.25:
        hole = first + chance.choice((10, 302, 312, 350))
        tags["missing"] = {"address": f"{word}{hole}", "type": "uint16"}
        missing[name] = frozenset((hole,))
    device["tags"] = tags
    return device


def _rule(chance: random.Random) -> dict[str, Any]:
    return {"verify": chance.random() < 0.4, "repeat": chance.random() < 0.3}


# What goes wrong

_STATION_KINDS = (
    "deaf",
    "deaf",
    "mute",
    "lose",
    "cut",
    "slow",
    "late",
    "very-late",
    "foreign",
    "junk",
    "reboot",
)
_LINE_KINDS = ("noise", "noise", "noise-after", "vanish", "vanish", "hang", "flicker")


_ONLY: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "noisy": ((), ("noise-after",)),
    "late": (("late",), ()),
    "tardy": (("very-late",), ()),
}


def _line_episodes(
    name: str,
    line: dict[str, Any],
    chance: random.Random,
    seconds: float,
    haste: float,
    pace: str,
) -> list[Episode]:
    stations, wires = _ONLY.get(pace, (_STATION_KINDS, _LINE_KINDS))
    found = _series(name, "", wires, chance, seconds, 1500.0 * haste)
    for device in line["devices"]:
        found += _series(name, device, stations, chance, seconds, 700.0 * haste)
    return found


def _series(
    line: str,
    device: str,
    kinds: tuple[str, ...],
    chance: random.Random,
    seconds: float,
    pause: float,
) -> list[Episode]:
    """One after the other, never two at once."""
    found = []
    at = chance.expovariate(1 / pause)
    while kinds and at < seconds - CALM:
        kind = chance.choice(kinds)
        last = _LASTS.get(kind, lambda c: c.choice((2.0, 20.0, 60.0, 300.0)) * c.uniform(0.5, 1))
        end = min(at + last(chance), seconds - CALM)
        found.append(Episode(at, end, line, device, kind, _STRENGTHS.get(kind, _half)(chance)))
        at = end + chance.expovariate(1 / pause)
    return found


def _half(chance: random.Random) -> float:
    return chance.choice((0.05, 0.3, 0.7))


_LASTS: dict[str, Callable[[random.Random], float]] = {
    "reboot": lambda chance: chance.uniform(0.5, 8.0),
    "flicker": lambda chance: chance.uniform(0.01, 1.0),
}
_STRENGTHS: dict[str, Callable[[random.Random], float]] = {
    "noise": lambda chance: chance.choice((1e-4, 1e-3, 1e-2)),
    "noise-after": lambda chance: chance.choice((1e-5, 1e-4, 1e-3)),
}
