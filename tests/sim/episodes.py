"""Draws the faults of a line, each with its time."""

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

SILENT = (
    *("deaf", "mute", "vanish", "hang", "hung", "stall", "reset"),
    *("held-replies", "held-requests"),
)
CALM = 1000.0  # seconds without faults at the end


@dataclass(frozen=True)
class Episode:
    """One fault and its duration. Times in seconds from the start."""

    start: float
    end: float
    line: str
    device: str  # empty: the line
    kind: str
    strength: float
    tag: str = ""  # empty: all of them

    @property
    def silent(self) -> bool:
        """The device does not reply meanwhile."""
        return self.kind in SILENT


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
_LINE_KINDS = (
    "noise",
    "noise",
    "noise-after",
    "vanish",
    "vanish",
    "hang",
    "stall",
    "stall",
    "flicker",
)
# TCP neither loses nor invents bytes, but its devices have faults.
_NET_STATION_KINDS = tuple(kind for kind in _STATION_KINDS if kind != "junk")
_NET_LINE_KINDS = ("vanish", "hang", "flicker")

_ONLY: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "noisy": ((), ("noise-after",)),
    "late": (("late",), ()),
    "tardy": (("very-late",), ()),
    "hostile": ((), ()),
}


def line_episodes(
    name: str,
    line: dict[str, Any],
    chance: random.Random,
    seconds: float,
    haste: float,
    pace: str,
) -> list[Episode]:
    """Draws the episodes of a line and its devices, except the devices for broadcasts."""
    stations: tuple[str, ...] = _STATION_KINDS
    wires: tuple[str, ...] = _LINE_KINDS
    if line["port"].startswith("tcp:"):
        stations, wires = _NET_STATION_KINDS, _NET_LINE_KINDS
    if pace in _ONLY:
        may = _ONLY[pace]
        stations = tuple(kind for kind in may[0] if kind in stations)
        wires = tuple(kind for kind in may[1] if kind in wires)
    found = series(name, "", wires, chance, seconds, 1500.0 * haste, _LASTS)
    for device in line["devices"]:
        found += series(name, device, stations, chance, seconds, 700.0 * haste, _LASTS)
    return found


def disappearances(
    line: str, name: str, device: dict[str, Any], chance: random.Random, seconds: float
) -> list[Episode]:
    """Draws addresses that a PLC's program removes, for a while or for good."""
    found = []
    never = device["tags"].get("missing", {"address": None})["address"]
    known = [
        name
        for name, tag in device["tags"].items()
        if name != "told" and tag["address"].partition(".")[0] != never
    ]
    at = chance.expovariate(1 / 2400)
    while at < seconds - CALM:
        tag = chance.choice(known)
        end = min(at + chance.choice((5.0, 60.0, 600.0, 1500.0)), seconds - CALM)
        forever = chance.random() < 0.2
        found.append(Episode(at, seconds + CALM if forever else end, line, name, "gone", 1.0, tag))
        if forever:
            break
        at = end + chance.expovariate(1 / 2400)
    return found


def series(
    line: str,
    device: str,
    kinds: tuple[str, ...],
    chance: random.Random,
    seconds: float,
    pause: float,
    lasts: Mapping[str, Callable[[random.Random], float]],
) -> list[Episode]:
    """Draws episodes that do not overlap."""
    found = []
    at = chance.expovariate(1 / pause)
    while kinds and at < seconds - CALM:
        kind = chance.choice(kinds)
        last = lasts.get(kind, _usual)
        end = min(at + last(chance), seconds - CALM)
        found.append(Episode(at, end, line, device, kind, _STRENGTHS.get(kind, _half)(chance)))
        at = end + chance.expovariate(1 / pause)
    return found


def _usual(chance: random.Random) -> float:
    return chance.choice((2.0, 20.0, 60.0, 300.0)) * chance.uniform(0.5, 1)


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
