"""Draws a plant from a seed: its configuration file, its wires, its faults."""

import json
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.sim.arrays import add_arrays
from tests.sim.episodes import Episode, disappearances, line_episodes
from tests.sim.hostile import bridges, hostile_episodes, hostile_manners
from tests.sim.manners import Manners
from tests.sim.more import add_neighbours, add_to, net_line, raw_line, rule
from tests.sim.transfer_rows import add_transfers

PROTOCOLS = ("vigor", "computer-link", "modbus-rtu", "modbus-ascii")
# How often tags are read: `busy` fills the wires, `lean` leaves time for many hours.
PACES = {
    "busy": ("200ms", "500ms", "1s", "1s", "2s", "2s", "5s", "10s"),
    "noisy": ("500ms", "1s"),  # storms of one kind only, see below
    "late": ("500ms", "1s"),
    "tardy": ("500ms", "1s"),
    "storm": ("500ms", "1s", "2s"),  # ten times as many faults
    "lean": ("20s", "30s", "60s", "60s"),
    "groups": ("500ms", "1s", "2s"),  # clients write several tags at once, some side by side
    "hostile": ("200ms", "200ms", "500ms", "1s"),  # other parties on the line, and no other fault
}


@dataclass(frozen=True)
class Drawn:
    """A plant drawn from a seed. Times in seconds from the start."""

    document: dict[str, Any]
    missing: dict[str, frozenset[int]]  # by device: addresses of its words that it refuses
    episodes: tuple[Episode, ...]
    jumps: tuple[tuple[float, float], ...]  # of the wall clock: when, by how many seconds
    chunks: dict[str, int]  # by line: characters in a piece of a UART
    zeros: dict[str, bool]  # by line: a broken character is read as zero
    manners: dict[str, Manners]  # by device
    bridges: dict[str, float]  # by line: the time-out of a bridge to serial units

    def write(self, folder: Path) -> Path:
        path = folder / "config.yaml"
        path.write_text(json.dumps(self.document))
        return path


def draw(seed: int, seconds: float, pace: str = "busy") -> Drawn:
    chance = random.Random(f"plant {seed}")
    lines: dict[str, Any] = {}
    missing: dict[str, frozenset[int]] = {}
    chunks, zeros = {}, {}
    haste = 1.0 if pace in ("busy", "lean") else 0.1
    episodes: list[Episode] = []
    for number in range(chance.choice((1, 1, 1, 2, 2, 3))):
        name = f"line{number}"
        lines[name] = _line(name, chance, missing, PACES[pace])
        chunks[name] = chance.choice((0, 0, 16, 16, 1) if pace == "busy" else (0, 0, 0, 16))
        zeros[name] = chance.random() < 0.5
        episodes += line_episodes(name, lines[name], chance, seconds, haste, pace)
    more = random.Random(f"more {seed}")
    for name, line in lines.items():
        add_to(name, line, more)
    for name, make in (("net", net_line), ("raw", raw_line)):
        if more.random() < 0.4:
            lines[name] = make(name, more, PACES[pace])
            chunks[name] = more.choice((0, 1, 1, 16))
            zeros[name] = more.random() < 0.5
            episodes += line_episodes(name, lines[name], more, seconds, haste, pace)
    add_neighbours(lines, missing, seed, pace)
    add_arrays(lines, seed)
    rows = add_transfers(lines, seed)
    if pace in ("busy", "lean", "storm"):
        for name, line in lines.items():
            for device, settings in line["devices"].items():
                if settings["protocol"] != "frames" and settings["station"] != 0:
                    episodes += disappearances(name, device, settings, more, seconds)
    episodes += hostile_episodes(lines, seed, seconds, pace)
    jumps = []
    at = chance.expovariate(1 / 1800)
    while at < seconds:
        jumps.append((at, chance.choice((-7200.0, -3600.0, -1.0, 1.0, 3600.0, 1e6, -1e6))))
        at += chance.expovariate(1 / 1800)
    _force_formats(lines)
    document = {
        "gateway": {"name": "demo"},
        "defaults": {"publish": chance.choice(("always", "always", "change"))},
        "lines": lines,
    } | ({"transfers": rows} if rows else {})
    manners, between = hostile_manners(lines, seed, pace), bridges(lines, seed, pace)
    in_order = tuple(sorted(episodes, key=_order))
    return Drawn(document, missing, in_order, tuple(jumps), chunks, zeros, manners, between)


def _force_formats(lines: dict[str, Any]) -> None:
    """Says of each Vigor station that it has the format of its line."""
    for line in lines.values():
        for device in line["devices"].values():
            if device["protocol"] == "vigor" and line.get("format", "7E1") != "7E1":
                device["format"] = line["format"]


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
    tags["w0"] = {"address": f"{word}{first + 330}", "type": "uint16", "write": rule(chance)}
    tags["w1"] = {"address": f"{word}{first + 332}", "type": "uint32", "write": rule(chance)}
    tags["w2"] = {"address": f"{bit}{300 + chance.randrange(100)}", "write": rule(chance)}
    tags["w3"] = {"address": f"{word}{first + 340}.3", "write": rule(chance)}
    if chance.random() < 0.3:
        tags["slow"] = {"address": f"{word}{first + 311}", "type": "uint16", "every": "30s"}
    if chance.random() < 0.25:
        hole = first + chance.choice((10, 302, 312, 350))
        tags["missing"] = {"address": f"{word}{hole}", "type": "uint16"}
        missing[name] = frozenset((hole,))
    device["tags"] = tags
    return device
