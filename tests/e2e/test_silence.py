"""A station falls silent and comes back; Zenoh clients in another process observe it.

The configuration says `every: 1s`, `reply_timeout: 200ms` and `retries: 5`, and leaves
`late_guard` as long as the reply time-out: the station is offline after 2.4 s, and its values
must turn bad before. It is then probed every 1 to 4 s.
"""

import signal
from collections.abc import Iterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.e2e.processes import Program, started, station, write_config
from tests.zenoh_peer import Received, ZenohPeer, free_endpoint

EVERY = 1.0
SLACK = 0.15  # s: two processes share a machine with everything else
ALIVE = "plant/@gateway/demo/alive"


class Plant(NamedTuple):
    endpoint: str
    plc: Program
    gateway: Program


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    """Two PLCs on one line."""
    tags = {"speed": {"address": "D10"}, "fault": {"address": "M5"}}
    devices: dict[str, Any] = {
        name: {
            "protocol": "vigor",
            "station": number,
            "reply_timeout": "200ms",
            "retries": 5,
            "tags": tags,
        }
        for name, number in (("mixer", 1), ("oven", 2))
    }
    devices["mixer"]["tags"] = {**tags, "recipe": {"address": "D500", "write": True}}
    tty = tmp_path / "tty"
    line = {"port": str(tty), "baudrate": 19200, "format": "7E1", "devices": devices}
    endpoint = free_endpoint()
    config = write_config(
        tmp_path / "config.yaml",
        endpoint,
        {"hall": line},
        defaults={"every": "1s", "publish": "always"},
    )
    with station("pty", str(tty), stations=(1, 2)) as plc:
        plc.tell("count 1 D 10")
        plc.tell("count 2 D 10")
        with started(config) as gateway:
            yield Plant(endpoint, plc, gateway)


async def test_quality_goes_bad_within_two_intervals_and_good_again(plant: Plant) -> None:
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        alive = await client.liveliness(f"{ALIVE}/*")
        heard = await client.subscribe("plant/**")
        await alive.until(lambda a: {f"{ALIVE}/mixer", f"{ALIVE}/oven"} <= a.latest().keys())
        await heard.next(lambda s: s.key == "plant/mixer/speed" and _good(s))

        plant.plc.tell("mute 1")
        bad = await heard.next(lambda s: s.key == "plant/mixer/speed" and _bad(s))
        assert bad.json["value"] is None
        assert bad.json["reason"] == "no-reply"
        last_good = [s for s in heard.samples if s.key == bad.key and _good(s)][-1]
        assert _time(bad) - _time(last_good) <= 2 * EVERY + SLACK
        await heard.next(lambda s: s.key == "plant/mixer/fault" and _bad(s))
        gone = await alive.next(lambda t: t.kind == "DELETE")
        assert gone.key == f"{ALIVE}/mixer"

        # Its neighbour goes on, in time.
        key = "plant/oven/speed"
        await heard.until(lambda h: sum(s.key == key for s in h.samples) >= 4)
        oven = [_time(s) for s in heard.samples if s.key == key and _good(s)]
        neighbour = [s for s in heard.samples if s.key.startswith("plant/oven/")]
        assert all(_good(s) or s.json["reason"] == "starting" for s in neighbour)
        assert max(b - a for a, b in pairwise(oven)) < 2 * EVERY

        [state] = await client.get("plant/mixer/speed")
        assert state.json["quality"] == "bad"
        [refused] = await client.get("plant/mixer/recipe/@set", b"7")
        assert not refused.ok
        assert refused.json["error"] == "no-reply"
        assert plant.plc.tell("get 1 D 500") == "0"

        heard.forget()
        alive.forget()
        plant.plc.tell("speak 1")
        back = await heard.next(lambda s: s.key == "plant/mixer/speed" and _good(s), timeout=300)
        assert back.json["value"] > last_good.json["value"]
        await heard.next(lambda s: s.key == "plant/mixer/fault" and _good(s))
        came = await alive.next(lambda t: t.kind == "PUT")
        assert came.key == f"{ALIVE}/mixer"
        await client.until_alive(f"{ALIVE}/*", [f"{ALIVE}/mixer", f"{ALIVE}/oven"])
        [device] = await client.get("plant/@gateway/demo/devices/mixer")
        assert device.json["failures"]["silence"] >= 3


async def test_a_write_with_a_lost_reply_is_unclear(plant: Plant) -> None:
    """A mute station carries out requests, so the outcome of a write is unknown."""
    async with ZenohPeer("client", connect=[plant.endpoint]) as client:
        [good] = await client.get("plant/mixer/recipe/@set", b"3")
        assert good.ok
        plant.plc.tell("mute 1")
        [reply] = await client.get("plant/mixer/recipe/@set", b"7")
        assert not reply.ok
        assert reply.json["error"] in ("unclear", "no-reply")
        done = plant.plc.tell("get 1 D 500") == "7"
        assert reply.json["error"] == "unclear" or not done


async def test_the_gateways_token_ends_with_the_gateway(plant: Plant) -> None:
    """Seen through a router between gateway and client, killed without a word."""
    endpoint = free_endpoint()
    async with (
        ZenohPeer("router", listen=[endpoint], connect=[plant.endpoint]),
        ZenohPeer("client", connect=[endpoint]) as client,
    ):
        alive = await client.liveliness("plant/@gateway/*")
        came = await alive.next(lambda t: t.kind == "PUT")
        assert came.key == "plant/@gateway/demo"
        plant.gateway.end(signal.SIGKILL)
        gone = await alive.next(lambda t: t.kind == "DELETE")
        assert gone.key == "plant/@gateway/demo"


def _good(sample: Received) -> bool:
    return bool(sample.json["quality"] == "good")


def _bad(sample: Received) -> bool:
    """It is bad, and was good before."""
    return not _good(sample) and bool(sample.json["reason"] != "starting")


def _time(sample: Received) -> float:
    return datetime.fromisoformat(sample.json["time"]).timestamp()
