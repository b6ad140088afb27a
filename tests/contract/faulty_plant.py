"""A plant with faults, and a consumer that reads all its documents by the schemas alone."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from gateway.contract.documents.catalogue import GET, PAST, SUBSCRIBE
from tests.contract.reader import Reader
from tests.e2e.processes import Program, free_port, started, station, vigor_line, write_config
from tests.zenoh_peer import Received, Reply, free_endpoint

TAGS = {
    "speed": {"address": "D10", "history": True},  # counts
    "recipe": {"address": "D500", "write": {"min": 1, "max": 40, "verify": True}, "history": True},
    "trim": {"address": "D501", "write": True},
    "hole": {"address": "D700"},
    "level": {
        "address": "D20",
        "scale": 0.1,
        "decimals": 1,
        "clamp": [0, 100],
        "alarm": {"high": 80, "hysteresis": 1, "text": "full"},
    },
    "load": {"address": "D22", "range": [0, 100]},
    "mode": {"address": "D21", "enum": {0: "off", 1: "auto"}, "write": True},
    "steps": {"address": "D510", "type": "uint16[4]"},
    "name": {"address": "D600", "type": "string[8]"},
    "plain": {"address": "D30", "payload": "raw"},
    "double": {"computed": "speed * 2"},
    "power": {"address": "D40", "type": "float32"},
}
_LINK = {"protocol": "computer-link", "control": True, "frame_format": 4}
LINES = {
    "sim": {
        "port": "simulator",
        "baudrate": 19200,
        "format": "7E1",
        "devices": {
            "oven": {
                **_LINK,
                "station": 5,
                "blocks": True,
                "tags": {"heat": {"address": "D0100", "write": True}},
            }
        },
    },
    "gone": {
        "port": f"tcp://127.0.0.1:{free_port()}",
        "devices": {
            "far": {
                "protocol": "modbus-tcp",
                "station": 1,
                "tags": {"flow": {"address": "holding:1"}},
            }
        },
    },
}
SERVED = {
    "serve": True,
    "devices": {
        "panel": {
            "protocol": "modbus-tcp",
            "tags": {"shown": {"address": "holding:0", "source": "mixer/speed"}},
        }
    },
}
SUBSCRIBED = (
    "plant/**",
    "plant/*/@block",
    "plant/@gateway/**",
    "plant/@gateway/demo/lines/hall/@trace",
)
REQUESTS = [
    ("plant/@gateway/demo/doors/laptop", b'{"do":"release"}'),
    ("plant/mixer/recipe/@set", b"5"),
    ("plant/mixer/recipe/@set", b"99"),
    ("plant/mixer/speed/@set", b"1"),
    ("plant/mixer/@set", b'{"recipe": 6, "trim": 1}'),
    ("plant/mixer/@set", b'{"recipe": 6, "speed": 1}'),
    ("plant/mute/a/@set", b"1"),
    ("plant/oven/heat/@set", b"7"),
    ("plant/oven/@run", b""),
    ("plant/oven/@loopback", b"AB"),
    ("plant/@gateway/demo/lines/sim/global", b"on"),
    ("plant/mixer/@peek", b"D10..D12"),
    ("plant/mixer/@peek", b"nothing"),
    ("plant/@gateway/demo/alarms/mixer/level", b'{"by": "Ana"}'),
    ("plant/@gateway/demo/alarms/mixer/level", b"{}"),
]
QUERIES = {
    GET: [
        "plant/**",
        "plant/**/@meta",
        "plant/*/@block",
        "plant/@gateway/**",
        "plant/@gateway/*/@describe",
        "plant/@gateway/*/@introspect",
        "plant/mixer/**?page=3",
        "plant/@gateway/demo/page?_time=[..];page=3",
        "plant/mixer/speed?max_age=0s",
        "plant/mixer/speed?max_age=never",
    ],
    PAST: [
        "plant/mixer/**?_time=[now(-1h)..]",
        "plant/mixer/speed?_time=[now(-1h)..];bucket=1h",
        "plant/mixer/recipe?_time=[never]",
        "plant/@gateway/demo/writes?_time=[now(-1h)..]",
        "plant/@gateway/demo/alarms/**?_time=[now(-1h)..]",
        "plant/@gateway/demo/audit/*?_time=[now(-1h)..]",
    ],
}


class Plant(NamedTuple):
    endpoint: str
    plc: Program


@contextmanager
def faulty_plant(folder: Path) -> Iterator[Plant]:
    """A plant with a PLC that loses replies and lacks an address, a dead line, a served one."""
    endpoint, own = free_endpoint(), str(folder / "tty")
    hall = vigor_line(own, TAGS, retries=0)
    hall["devices"]["mute"] = {
        **hall["devices"]["mixer"],
        "station": 2,
        "tags": {"a": {"address": "D1"}},
    }
    door = {"line": "hall", "listen": f"127.0.0.1:{free_port()}", "protocol": "vigor"}
    config = write_config(
        folder / "config.yaml",
        endpoint,
        {**LINES, "hall": hall, "panel": {"port": f"tcp://127.0.0.1:{free_port()}", **SERVED}},
        history={"path": "history.db"},
        alarms={"path": "alarms.json", "devices": True, "lines": True},
        gateway={"name": "demo", "standby": "hall", "audit": "audit.jsonl"},
        notify={"command": ["/bin/false"], "rules": [{"to": ["command"]}]},
        share={"doors": {"laptop": door}},
        transfers=[{"from": "mixer/speed", "to": "mixer/trim", "every": "1s", "stale": "9s"}],
    )
    with station("pty", own, stations=(1, 2)) as plc:
        plc.tell("hole 1 D 700")
        plc.tell("count 1 D 10")
        plc.tell("mute 2")
        with started(config):
            yield Plant(endpoint, plc)


def replied(reader: Reader, key: str, verb: str, replies: list[Reply]) -> None:
    for reply in replies:
        if reply.encoding == "application/json":
            assert reply.ok or "error" in reply.json
            reader.read(reply.key or key, verb, reply.json)


def subscribed(reader: Reader, sample: Received) -> None:
    if sample.attachment:
        reader.read(sample.key, SUBSCRIBE, json.loads(sample.attachment))
    if sample.encoding == "application/json" and sample.payload:
        reader.read(sample.key, SUBSCRIBE, sample.json)
