"""A Computer Link PLC, byte by byte from the manual, behind a cable.

PLC, cable, gateway and Zenoh client are processes of their own.
"""

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.conftest import Command, needs
from tests.e2e.processes import Program, cable, started, until, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {
    "temperature": {"address": "D0100", "scale": 0.1},
    "cycles": {"address": "C200"},
    "door": {"address": "X17"},
    "far": {"address": "D3000"},
    "level": {"address": "TN5"},
    "setpoint": {"address": "D500", "write": True},
    "speed": {"address": "D700", "write": {"verify": True}},
} | {f"lamp{n}": {"address": f"M{50 * n}", "write": True} for n in range(8)}


class Oven(NamedTuple):
    plc: Program
    gateway: Program
    endpoint: str
    config: Path


# One plant for all: each test sets a temperature of its own.
@pytest.fixture(scope="module", params=[1, 4], ids=["format 1", "format 4"])
def oven(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Oven]:
    socat, endpoint = needs("socat"), free_endpoint()
    folder = tmp_path_factory.mktemp("oven")
    near, far = folder / "near", folder / "far"
    device = {
        "protocol": "computer-link",
        "station": 5,
        "frame_format": request.param,
        "reply_timeout": "1s",
        "monitor": True,
        "control": True,
        "tags": TAGS,
    }
    line = {"port": str(near), "baudrate": 19200, "format": "7E1", "devices": {"oven": device}}
    config = write_config(folder / "config.yaml", endpoint, {"hall": line})
    with ExitStack() as stack:
        stack.enter_context(cable(socat, near, f"pty,raw,echo=0,link={far}"))
        module = sys.executable, "-m", "tests.e2e.link_peer"
        plc = stack.enter_context(Program(*module, 5, request.param, far))
        plc.says("ready")
        gateway = stack.enter_context(started(config))
        yield Oven(plc, gateway, endpoint, config)


async def test_values_and_writes(oven: Oven) -> None:
    expected = {"temperature": 21.5, "cycles": 70000, "door": True, "level": 33, "far": 4}
    async with ZenohPeer("client", connect=[oven.endpoint]) as client:
        heard = await client.subscribe("plant/oven/*")
        for name, value in (
            ("D0100", 215),
            ("CN200", 70000),
            ("X0017", 1),
            ("TN005", 33),
            ("D3000", 4),
        ):
            oven.plc.tell(f"set {name} {value}")
        await heard.until(
            lambda h: all(
                (s := h.latest().get(f"plant/oven/{name}")) is not None and s.json["value"] == value
                for name, value in expected.items()
            )
        )
        for name, number in (("setpoint", b"-7"), ("speed", b"1200")):
            [reply] = await client.get(f"plant/oven/{name}/@set", number)
            assert reply.ok, reply.payload
        assert oven.plc.tell("get D0500") == str(65536 - 7)
        assert oven.plc.tell("get D0700") == "1200"
        oven.plc.tell("heard")
        told = await client.subscribe("plant/@gateway/demo/writes")
        for n in range(8):  # faster than the wire
            await client.put(f"plant/oven/lamp{n}/@set", b"true")
        await told.until(lambda h: len(h.samples) == 8)
        assert {sample.json["outcome"] for sample in told.samples} == {"written"}
        assert [oven.plc.tell(f"get M{50 * n:04}") for n in range(8)] == ["1"] * 8
        assert "BT" in oven.plc.tell("heard").split()


async def test_a_plc_that_loses_its_list_and_sends_unsolicited_frames(oven: Oven) -> None:
    async with ZenohPeer("client", connect=[oven.endpoint]) as client:
        heard = await client.subscribe("plant/oven/*")
        oven.plc.tell("set D0100 216")
        await heard.next(lambda s: s.json.get("value") == 21.6)
        assert {"MB", "MN"} & set(oven.plc.tell("heard").split())
        oven.plc.tell("say 7777")
        assert "on-demand data of station 5: 7777" in oven.gateway.says("stray frame")
        oven.plc.tell("forget")
        oven.plc.tell("set D0100 300")
        await heard.next(lambda s: s.json.get("value") == 30.0)
        assert {"BM", "WM"} & set(oven.plc.tell("heard").split())
        assert not [s for s in heard.samples if s.json["quality"] == "bad" and _read(s.json)]
        await client.get_until(
            "plant/@gateway/demo/devices/oven", lambda device: device["unasked_frames"] >= 1
        )


async def test_a_bad_address_and_an_offline_plc(oven: Oven) -> None:
    async with ZenohPeer("client", connect=[oven.endpoint]) as client:
        heard = await client.subscribe("plant/oven/*")
        oven.plc.tell("gone D0500")
        await heard.next(lambda s: s.key.endswith("setpoint") and s.json.get("reason") == "refused")
        oven.plc.tell("set D0100 217")
        await heard.next(lambda s: s.json.get("value") == 21.7)
        [refused] = await client.get("plant/oven/setpoint/@set", b"1")
        assert not refused.ok
        assert (refused.json["error"], refused.json["code"]) == ("refused", "06")
        oven.plc.tell("mute")
        await heard.next(
            lambda s: s.key.endswith("temperature") and s.json.get("reason") == "no-reply"
        )
        oven.gateway.says("device offline", "6306", "D8121")
        heard.forget()
        oven.plc.tell("speak")
        await heard.next(lambda s: s.json.get("value") == 21.7)


async def test_control(command: Command, oven: Oven) -> None:
    async with ZenohPeer("client", connect=[oven.endpoint]) as client:
        heard = await client.subscribe("plant/oven/*")
        oven.plc.tell("set D0100 218")
        await heard.next(lambda s: s.json.get("value") == 21.8)
        [model] = await client.get("plant/oven/@model")
        assert model.json["answer"] == "9D (FX2N)"
        [loopback] = await client.get("plant/oven/@loopback", b"HELLO")
        assert loopback.json["answer"] == "HELLO"
        for name in ("run", "stop"):
            [reply] = await client.get(f"plant/oven/@{name}")
            assert reply.json["answer"] == "acknowledged"
        [sent] = await client.get("plant/@gateway/demo/lines/hall/global", b"on")
        assert "none answers" in sent.json["answer"]
        until(lambda: oven.plc.tell("get M8126") == "1", "the flag changes")
    oven.gateway.says("command executed", "@stop")
    done = command("control", oven.config, "oven", "loopback", "HI")
    assert (done.code, done.out) == (0, "HI\n")
    done = command("control", oven.config, "oven", "global", "off")
    assert done.code == 0
    until(lambda: oven.plc.tell("get M8126") == "0", "the flag changes")
    done = command("control", oven.config, "oven", "loopback", "HI", "--json")
    assert (done.code, {*done.json}) == (0, {"answer", "time", "took"})
    oven.plc.tell("mute")
    done = command("control", oven.config, "oven", "model", "--json")
    # A poll may fail first: the command waits for the device, which stays silent.
    assert (done.code, done.json["error"] in ("no-reply", "busy")) == (1, True), done


def _read(document: dict[str, object]) -> bool:
    return document.get("reason") != "starting"
