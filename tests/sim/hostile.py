"""Draws what other parties do to a line: a second master, a second station, a device server.

It uses its own `random.Random`, so all other faults of a seed stay as they are.
"""

import random
from collections.abc import Callable, Iterator
from typing import Any

from tests.sim.episodes import CALM, Episode, series
from tests.sim.manners import SILENT, Manners, manners_of

STATION_KINDS: tuple[str, ...] = (
    *("twice", "twice", "held-replies", "held-requests", "twin", "refusing"),
)
LINE_KINDS: tuple[str, ...] = ("reset", "reset", "master", "master", "buffering", "pour", "hung")
NET_STATION_KINDS: tuple[str, ...] = ("twice", "refusing", "deaf")
NET_LINE_KINDS: tuple[str, ...] = ("hung",)
PARTIES = frozenset((*STATION_KINDS, *LINE_KINDS, "frozen"))
# Requests arrive later.
DELAYING = ("stall", "hang", "held-requests", "reset", "master", "buffering")
HUNG = 120.0  # seconds within which a connection without any reply is opened again
RESETS = 4  # at most, in one episode
HASTE = {"hostile": 0.1}  # paces with other parties: how short the pauses between them are


def hostile_episodes(
    lines: dict[str, Any], seed: int, seconds: float, pace: str
) -> Iterator[Episode]:
    """Draws the episodes of all lines and devices, except the devices for broadcasts."""
    if pace not in HASTE:
        return
    chance, haste = random.Random(f"hostile {seed}"), HASTE[pace]
    for name, line in lines.items():
        tcp = line["port"].startswith("tcp:")
        wires = NET_LINE_KINDS if tcp else LINE_KINDS
        if not any(map(_is_polled, line["devices"].values())):
            # No reply is missed: a hung connection looks like a device that has nothing to say.
            wires = tuple(kind for kind in wires if kind != "hung")
        stations = NET_STATION_KINDS if tcp else STATION_KINDS
        yield from series(name, "", wires, chance, seconds, 1500.0 * haste, LASTS)
        for device, settings in line["devices"].items():
            if settings.get("station") != 0:
                yield from series(name, device, stations, chance, seconds, 700.0 * haste, LASTS)

    at = chance.expovariate(1 / (3600.0 * haste))
    while at < seconds - CALM:
        end = min(at + chance.uniform(1.0, 5.0), seconds - CALM)
        for name in lines:
            yield Episode(at, end, name, "", "frozen", 1.0)
        at = end + chance.expovariate(1 / (3600.0 * haste))


def hostile_manners(lines: dict[str, Any], seed: int, pace: str) -> dict[str, Manners]:
    """Draws the manners of all devices, by name."""
    if pace not in HASTE:
        return {}
    chance = random.Random(f"manners {seed}")
    return {
        name: manners_of(device, chance)
        for line in lines.values()
        for name, device in line["devices"].items()
    }


def bridges(lines: dict[str, Any], seed: int, pace: str) -> dict[str, float]:
    """Draws the connections that end at a bridge to serial units: by line, its time-out.

    Not drawn: a bridge that waits longer than the gateway, before a unit that is silent about
    unknown addresses. All its replies come too late, and the device flaps until the file gives it a
    longer `reply_timeout`, as its diagnosis says.
    """
    manners = hostile_manners(lines, seed, pace)
    chance = random.Random(f"bridge {seed}")
    timeouts = {name: chance.choice((0.0, 0.6, 1.0, 3.0)) for name in sorted(lines)}
    tcp = {name for name, line in lines.items() if line["port"].startswith("tcp:")}
    return {
        name: _shorter(timeouts[name], lines[name]["devices"], manners)
        for name in tcp
        if pace in HASTE
    }


def _shorter(timeout: float, devices: dict[str, Any], manners: dict[str, Manners]) -> float:
    """Returns the time-out of a bridge; 0 if one of its units cannot be behind it."""
    for name, device in devices.items():
        waits = (int(device[key].removesuffix("ms")) for key in ("reply_timeout", "late_guard"))
        if manners[name].unknown == SILENT and timeout >= sum(waits) / 1000:
            return 0.0
    return timeout


def _is_polled(device: dict[str, Any]) -> bool:
    if device["protocol"] != "frames":
        return device.get("station") != 0
    return bool(device.get("ask"))


def resets(episode: Episode) -> list[float]:
    """Returns the times at which the connection is reset in an episode."""
    if episode.kind != "reset":
        return []
    number = 1 + round(episode.strength * RESETS)
    step = (episode.end - episode.start) / (number + 1)
    return [episode.start + step * (i + 1) for i in range(number)]


def _held(chance: random.Random) -> float:
    return chance.choice((0.5, 2.0, 10.0, 60.0)) * chance.uniform(0.3, 1)


LASTS: dict[str, Callable[[random.Random], float]] = {
    "hung": lambda chance: HUNG,
    "pour": lambda chance: chance.uniform(0.3, 3.0),
    "refusing": lambda chance: chance.uniform(0.3, 5.0),
    "held-replies": _held,
    "held-requests": _held,
    "reset": lambda chance: chance.choice((1.0, 3.0, 10.0)) * chance.uniform(0.5, 1),
}
