"""Draws transfers between the PLCs of a plant."""

import random
from typing import Any

from tests.sim.more import LATER


def add_transfers(lines: dict[str, Any], seed: int) -> list[dict[str, Any]]:
    """Adds sources and targets to the PLCs, and returns the rows between them."""
    if seed < LATER:
        return []
    chance = random.Random(f"transfers {seed}")
    devices = {
        name: device
        for line in lines.values()
        for name, device in line["devices"].items()
        if "w1" in device["tags"]
    }
    kinds = {"0": "uint16", "1": f"uint16[{chance.choice((2, 5, 16))}]", "2": "bool"}
    free = [(name, number) for name in devices for number in kinds]
    chance.shuffle(free)
    rows: list[dict[str, Any]] = []
    for name, number in free[: chance.choice((0, 2, 4, 8))]:
        source = chance.choice(list(devices))
        known = [row["to"] for row in rows if row["to"].endswith(f"t{number}")]
        every = chance.choice(("2s", "5s", "20s"))
        _add(devices[name], f"t{number}", kinds[number], every, chance)
        if known and chance.random() < 0.3:
            place = chance.choice(known)  # a chain
        else:
            _add(devices[source], f"s{number}", kinds[number], every, chance)
            place = f"{source}/s{number}"
        owner, _, tag = place.partition("/")
        seconds = int(devices[owner]["tags"][tag]["every"].removesuffix("s"))
        stale = f"{seconds * chance.choice((1.5, 3, 10)):g}s"
        row: dict[str, Any] = {"from": place, "to": f"{name}/t{number}", "stale": stale}
        if chance.random() < 0.4:
            row["every"] = chance.choice(("2s", "7s"))
        if number == "0" and chance.random() < 0.3:
            row["offset"] = 1  # of every number but one
        if number != "1" and chance.random() < 0.5:
            row["if_stale"] = {"write": False if number == "2" else 7}
        rows.append(row)
    return rows


def _add(device: dict[str, Any], name: str, kind: str, every: str, chance: random.Random) -> None:
    area, bits = ("holding:", "coil:") if device["protocol"].startswith("modbus") else ("D", "M")
    first = int(device["tags"]["w0"]["address"].removeprefix(area)) + 300
    number = first + 20 * int(name[1]) + (0 if name[0] == "s" else 50)
    address = f"{bits}{1200 + number % 100}" if kind == "bool" else f"{area}{number}"
    tag: dict[str, Any] = {"address": address, "type": kind, "every": every}
    if name[0] == "t":
        tag["write"] = {"verify": chance.random() < 0.3, "repeat": False}
    device["tags"].setdefault(name, tag)
