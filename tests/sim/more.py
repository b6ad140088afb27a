"""Draws what a plant has beside its PLCs: no-protocol devices, Modbus TCP, broadcasts.

It uses its own `random.Random`, so the PLCs of a seed stay as they are.
"""

import random
from typing import Any

LATER = 900_000  # seeds from here on have more; those before keep the plants they had
MOST_WORDS = 3  # that some devices take in one request
SEPARATE = "<SOH>"  # no other protocol of ours begins with it


def add_to(name: str, line: dict[str, Any], chance: random.Random) -> None:
    """Adds settings that only some plants have to a drawn line."""
    devices = line["devices"]
    protocols = {device["protocol"] for device in devices.values()}
    unsummed, told = chance.random() < 0.4, chance.random() < 0.6
    for device in devices.values():
        if device["protocol"] == "computer-link":
            if unsummed:
                device["sum_check"] = device["monitor"] = False
            device["control"] = told
        if chance.random() < 0.12:
            device["verify_reads"] = 2
            device["retries"] = 3
    if protocols & {"modbus-rtu", "modbus-ascii"} and chance.random() < 0.3:
        devices[f"{name}-all"] = {
            "protocol": min(protocols),
            "station": 0,
            "tags": {
                "word": {"address": "holding:9000", "type": "uint16", "write": True},
                "long": {"address": "holding:9002", "type": "uint32", "write": True},
                "bit": {"address": "coil:9000", "write": True},
            },
        }


def net_line(name: str, chance: random.Random, intervals: tuple[str, ...]) -> dict[str, Any]:
    """Draws a Modbus TCP connection, with several units or with one that has a window."""
    window = chance.choice((1, 1, 2, 4, 16))
    every = chance.choice(intervals)
    devices = {}
    for i in range(chance.choice((1, 1, 2, 3))):
        timeout = chance.choice((100, 300, 500))
        first = chance.randrange(0, 400)
        tags: dict[str, Any] = {}
        for k in range(chance.randrange(4, 14)):
            address = first + 200 * (k % 8) + k
            tags[f"v{k}"] = {"address": f"holding:{address}", "type": "uint16"}
        tags |= {
            "long": {"address": f"holding:{first + 2000}", "type": "uint32"},
            "scaled": {"address": f"holding:{first + 2010}", "type": "uint16", "scale": 0.1},
            "flag": {"address": f"coil:{first}"},
            "bit": {"address": f"holding:{first + 2020}.10"},
            "w0": {"address": f"holding:{first + 2030}", "type": "uint16", "write": rule(chance)},
            "w1": {"address": f"holding:{first + 2032}", "type": "uint32", "write": rule(chance)},
            "w2": {"address": f"coil:{first + 300}", "write": rule(chance)},
            "w3": {"address": f"holding:{first + 2040}.3", "write": rule(chance)},
        }
        devices[f"{name}-{i}"] = {
            "protocol": "modbus-tcp",
            "station": i + 1,
            "window": window,
            "max_read_words": chance.choice((16, 125)),
            "reply_timeout": f"{timeout}ms",
            "late_guard": f"{timeout}ms",
            "retries": chance.choice((0, 1, 2)),
            "diagnostics": chance.random() < 0.3,
            "defaults": {"every": every},
            "tags": tags,
        }
    return {"port": "tcp://plant.test:502", "devices": devices}


# How frames are bounded: by a header and a terminator, with a sum or without, by the end of a
# text line, by silence.
_FRAMINGS: tuple[dict[str, Any], ...] = (
    {"header": SEPARATE, "terminator": "<ETX>", "sum_check": True, "max_length": 32},
    {"header": SEPARATE, "terminator": "<ETX>", "max_length": 32},
    {"ending": "CR LF", "max_length": 32},
    {"max_length": 32, "gap": "50ms"},
)


def raw_line(name: str, chance: random.Random, intervals: tuple[str, ...]) -> dict[str, Any]:
    """Draws no-protocol devices: one that sends by itself, some that reply, maybe a PLC."""
    devices: dict[str, Any] = {}
    every = chance.choice(intervals)
    speaks = chance.random() < 0.7
    asked = chance.choice((0, 1, 1, 2)) if speaks else chance.choice((1, 2, 3))
    framing = chance.choice(_FRAMINGS[:3] if asked + speaks > 1 else _FRAMINGS)
    if speaks:
        devices[f"{name}-z"] = _speaker("z", framing, every, chance, alone=not asked)
    for letter in "abc"[:asked]:
        devices[f"{name}-{letter}"] = _asked(letter, framing, every, chance)
    if asked and chance.random() < 0.3:
        devices[f"{name}-0"] = _neighbour(every, chance)
    return {
        "port": f"/dev/tty-{name}",
        "baudrate": chance.choice((9600, 19200)),
        "format": chance.choice(("8N1", "8E1", "7E1")),
        "echo": chance.random() < 0.15,
        "devices": devices,
    }


def _device(framing: dict[str, Any], chance: random.Random) -> dict[str, Any]:
    timeout = chance.choice((150, 300, 500))
    return {
        "protocol": "frames",
        "framing": dict(framing),
        "reply_timeout": f"{timeout}ms",
        "late_guard": f"{timeout}ms",
        "retries": chance.choice((1, 2)),
    }


def _asked(
    letter: str, framing: dict[str, Any], every: str, chance: random.Random
) -> dict[str, Any]:
    number, refused = {"type": "integer"}, f"{letter}ER(?P<code>[0-9]{{2}})"
    written = {"type": "integer", "format": "05d"}
    return _device(framing, chance) | {
        "defaults": {"every": every},
        "ask": {
            "both": {
                "send": f"{letter}Q0?",
                "match": f"{letter}Q0=(?P<x>[0-9]{{5}}),(?P<y>[0-9]{{5}})",
                "fields": {"x": number, "y": number},
                "refused": refused,
            },
            "held": {
                "send": f"{letter}Q1?",
                "match": f"{letter}Q1=(?P<set>[0-9]{{5}}),(?P<v>[0-9]{{5}})",
                "fields": {"set": number, "v": number},
            },
        },
        "write": {
            "set": {
                "send": f"{letter}S={{value}}",
                "value": written,
                "match": f"{letter}OK",
                "refused": refused,
            },
            "told": {"send": f"{letter}T={{value}}", "value": written},
        },
        "tags": {
            "x": {"address": "x"},
            "y": {"address": "y"},
            "v": {"address": "v"},
            "set": {"address": "set", "write": rule(chance)},
            "told": {"address": "told", "write": True},
        },
    }


def _speaker(
    letter: str, framing: dict[str, Any], every: str, chance: random.Random, alone: bool
) -> dict[str, Any]:
    """Draws a device that sends its weight again and again, and other texts now and then.

    Some of these devices are also polled and written to.
    """
    asked = chance.random() < 0.3
    period = chance.choice((0.4, 1.0, 5.0) if alone and not asked else (3.0, 8.0))
    weighing: dict[str, Any] = {
        "match": f"{letter}W=(?P<w>[0-9]{{5}})",
        "fields": {"w": {"type": "integer"}},
        "stale_after": f"{10 * period:g}s",
    }
    if chance.random() < 0.4:
        weighing["answer"] = f"{letter}!{{w}}"
    listen = {"weighing": weighing, "nothing": {"match": f"{letter}N"}}
    tags = {"w": {"address": "w", "event": chance.random() < 0.5}}
    if not asked:
        return _device(framing, chance) | {"listen": listen, "tags": tags}
    device = _asked(letter, framing, every, chance)
    return device | {"listen": listen, "tags": device["tags"] | tags}


def _neighbour(every: str, chance: random.Random) -> dict[str, Any]:
    first = chance.randrange(400)
    return {
        "protocol": "vigor",
        "station": 9,
        "reply_timeout": "300ms",
        "late_guard": "300ms",
        "defaults": {"every": every},
        "tags": {
            "v0": {"address": f"D{first}", "type": "uint16"},
            "scaled": {"address": f"D{first + 30}", "type": "uint16", "scale": 0.1},
            "flag": {"address": f"M{first % 200}"},
            "w0": {"address": f"D{first + 60}", "type": "uint16", "write": rule(chance)},
            "w2": {"address": f"M{300 + first % 100}", "write": rule(chance)},
        },
    }


def add_neighbours(
    lines: dict[str, Any], missing: dict[str, frozenset[int]], seed: int, pace: str
) -> None:
    """Adds tags that can be written, beside those that can: groups fill runs with them.

    Some devices lack a word in the middle.
    """
    if pace != "groups":
        return
    chance = random.Random(f"groups {seed}")
    for line in lines.values():
        for name, device in line["devices"].items():
            tags = device["tags"]
            if "w1" not in tags or device["protocol"] == "frames":
                continue
            area, first = _split(tags["w0"]["address"])
            _neighbours(tags, area, first, chance)
            if device["protocol"].startswith("modbus") and chance.random() < 0.4:
                device["max_write_words"] = MOST_WORDS  # so the array takes three requests
            if chance.random() < 0.2:
                missing[name] = missing.get(name, frozenset()) | {first + 4}


def _neighbours(tags: dict[str, Any], area: str, first: int, chance: random.Random) -> None:
    """Adds words, bits of a word, an array, and the bits that fill the byte of `w2`."""
    for tag, number in {
        "g0": first + 1,
        "g4": first + 4,
        "g5": first + 5,
        "g6": first + 11,
    }.items():
        tags[tag] = {"address": f"{area}{number}", "type": "uint16", "write": rule(chance)}
    for tag, bit in (("g7", 0), ("g8", 15)):
        tags[tag] = {"address": f"{area}{first + 10}.{bit}", "write": rule(chance)}
    array = {"address": f"{area}{first + 12}", "type": "uint16[7]", "write": rule(chance)}
    tags["g9"] = array
    bits, point = _split(tags["w2"]["address"])
    for number in range(point - point % 8, point - point % 8 + 8):
        if number != point:
            tags[f"b{number}"] = {"address": f"{bits}{number}", "write": rule(chance)}


def _split(address: str) -> tuple[str, int]:
    digits = len(address) - len(address.rstrip("0123456789"))
    return address[:-digits], int(address[-digits:])


def rule(chance: random.Random) -> dict[str, Any]:
    """Draws the rule for writes that end unclear."""
    return {"verify": chance.random() < 0.4, "repeat": chance.random() < 0.3}
