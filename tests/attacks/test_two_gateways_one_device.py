"""Two gateways that are configured by mistake with the same device: only one serves it."""

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.e2e.processes import (
    Program,
    free_port,
    gateway,
    held,
    plc_gateway,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import POLL, TIMEOUT, ZenohPeer, free_endpoint

RECIPE = "plant/mixer/recipe/@set"


class Plant(NamedTuple):
    router: str
    second: str  # another endpoint of the router, as of another machine
    client: ZenohPeer
    folder: Path
    programs: ExitStack

    def file(self, name: str, devices: dict[str, int], copy: str = "", at: str = "") -> Path:
        """Writes the configuration of a gateway with a wire of its own.

        `copy` tells two files of one name apart. `at`: another endpoint of the router.
        """
        port = free_port()
        self.programs.enter_context(station("tcp", str(port), stations=(1, 2)))
        tags = {"recipe": {"address": "D500", "write": True}}
        line = {
            "port": f"tcp://127.0.0.1:{port}",
            "baudrate": 19200,
            "devices": {
                device: {"protocol": "vigor", "station": number, "tags": tags}
                for device, number in devices.items()
            },
        }
        text = {
            "gateway": {"name": name},
            "zenoh": {"listen": [], "connect": [at or self.router]},
            "lines": {"hall": line},
        }
        file = self.folder / f"{name}{copy}.yaml"
        file.write_text(json.dumps(text))
        return file

    def run(self, file: Path) -> Program:
        return self.programs.enter_context(gateway("run", file))

    async def until_alive(self, *tokens: str) -> None:
        keys = [f"plant/@gateway/{token}" for token in tokens]
        await self.client.until_alive("plant/@gateway/*/alive/*", keys)


@asynccontextmanager
async def plant(folder: Path) -> AsyncIterator[Plant]:
    router, second = free_endpoint(), free_endpoint()
    with ExitStack() as programs:
        async with (
            ZenohPeer("router", listen=[router, second]),
            ZenohPeer("client", connect=[router]) as client,
        ):
            yield Plant(router, second, client, folder, programs)


def writes(program: Program) -> int:
    return sum("tag written" in line for line in program.lines)


async def test_the_second_gateway_leaves_the_device_to_the_first(tmp_path: Path) -> None:
    async with plant(tmp_path) as p:
        left = p.file("left", {"mixer": 1})
        right = p.file("right", {"mixer": 1, "oven": 2})
        a = p.run(left)
        await p.until_alive("left/alive/mixer")
        b = p.run(right)
        await asyncio.to_thread(b.says, "device refused", "mixer", "gateway left serves it")
        await p.until_alive("left/alive/mixer", "right/alive/oven")
        [status] = await p.client.get("plant/@gateway/right/status")
        assert status.json["refused_devices"] == {"mixer": "left"}
        assert list(status.json["devices"]) == ["oven"]

        # One gateway writes, and one answers; that of another device is silent.
        for target in ("BEST_MATCHING", "ALL"):
            for key in (RECIPE, "plant/oven/recipe/@set"):
                [reply] = await p.client.get(key, b"7", target=target)
                assert reply.ok
        [unknown] = await p.client.get("plant/oven/nothing/@set", b"7")
        assert unknown.json["error"] == "unknown-tag"
        outcomes = await p.client.subscribe("plant/@gateway/*/writes")
        await p.client.put(RECIPE, b"8")
        await outcomes.next(lambda s: s.key == "plant/@gateway/left/writes")
        await asyncio.to_thread(until, lambda: writes(a) == 3, "the log has the third write")
        assert writes(b) == 2

        # No gateway has the device: no answer, at once, and a clear error from our own client.
        assert await p.client.get("plant/press/recipe/@set", b"7", timeout=60) == []
        nobody = p.file("right", {"press": 2}, copy="-changed")
        done = await asyncio.to_thread(plc_gateway, "write", nobody, "press/recipe", "7")
        assert done.code == 1
        assert "no gateway accepts plant/press/recipe/@set: nothing was sent" in done.err


async def test_the_same_file_started_twice_serves_once(tmp_path: Path) -> None:
    """The second one ends with the reason. Also on another machine, and with another device."""
    async with plant(tmp_path) as p:
        file = p.file("demo", {"mixer": 1})
        a = p.run(file)
        await p.until_alive("demo/alive/mixer")
        b = p.run(file)
        c = p.run(p.file("demo", {"oven": 1}, copy="-copy", at=p.second))
        for one in (b, c):
            assert await asyncio.to_thread(one.ended) == 1
            assert not one.has_said("device online")
            assert not one.has_said("Traceback")
        assert b.has_said("plant/@gateway/demo runs already on this machine")
        assert c.has_said("another gateway named demo serves under plant already")
        [reply] = await p.client.get(RECIPE, b"7", target="ALL")
        assert reply.ok
        assert a.running


def test_the_same_file_started_twice_without_any_network_polls_once(tmp_path: Path) -> None:
    with plc_station(tmp_path) as port, ExitStack() as programs:
        lines = {"hall": vigor_line(str(port), {"speed": {"address": "D10"}})}
        alone = {"prefix": f"alone{os.getpid()}", "listen": [], "connect": []}
        file = write_config(tmp_path / "demo.yaml", "", lines, zenoh=alone)
        a = programs.enter_context(gateway("run", file))
        a.says("device online")
        b = programs.enter_context(gateway("run", file))
        assert b.ended() == 1
        assert b.has_said("runs already on this machine")
        # Another gateway with the same serial port: the system lets one open it.
        other = write_config(
            tmp_path / "other.yaml", "", lines, zenoh=alone, gateway={"name": "other"}
        )
        c = programs.enter_context(gateway("run", other))
        c.says("line down", "in use by another program")
        assert not c.has_said("device online")
        assert a.running
        # The name is free again when its process was killed.
        a.end(signal.SIGKILL)
        d = programs.enter_context(gateway("run", file))
        d.says("Zenoh session ready")


@contextmanager
def plc_station(folder: Path) -> Iterator[Path]:
    with station("pty", str(folder / "tty")):
        yield folder / "tty"


async def test_of_two_that_start_at_once_one_serves(tmp_path: Path) -> None:
    async with plant(tmp_path) as p:
        files = [p.file(name, {"mixer": 1}) for name in ("left", "right")]
        both = [p.run(file) for file in files]
        ends = [asyncio.create_task(asyncio.to_thread(one.ended)) for one in both]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        [stays] = [one for one in both if one.running]
        [ended] = [one for one in both if one is not stays]
        assert ended.has_said("serves every device of this file already")
        await asyncio.to_thread(stays.says, "device online")
        [reply] = await p.client.get(RECIPE, b"7", target="ALL")
        assert reply.ok
        stays.end()
        await asyncio.gather(*ends)


async def test_two_that_started_without_a_network_share_out_when_it_is_there(
    tmp_path: Path,
) -> None:
    """The one that was there first stays."""
    router = free_endpoint()
    with ExitStack() as programs:
        async with ZenohPeer("peer") as nobody:
            p = Plant(router, "", nobody, tmp_path, programs)
            a = p.run(p.file("right", {"mixer": 1, "oven": 2}))
            await asyncio.to_thread(a.says, "device online", "mixer")
            b = p.run(p.file("left", {"mixer": 1}))
            await asyncio.to_thread(b.says, "device online", "mixer")
        async with (
            ZenohPeer("router", listen=[router]),
            ZenohPeer("client", connect=[router]) as client,
        ):
            assert await asyncio.to_thread(b.ended) == 1
            assert b.has_said("gateway right serves every device of this file already")
            await client.until_alive(
                "plant/@gateway/*/alive/*",
                ["plant/@gateway/right/alive/mixer", "plant/@gateway/right/alive/oven"],
            )
            [reply] = await client.get(RECIPE, b"7", target="ALL")
            assert reply.ok
            assert not a.has_said("starts over")


async def test_a_gateway_that_was_frozen_keeps_its_device_when_it_wakes(tmp_path: Path) -> None:
    async with plant(tmp_path) as p:
        a = p.run(p.file("left", {"mixer": 1}))
        await p.until_alive("left/alive/mixer")
        with held(a.pid):
            b = p.run(p.file("right", {"mixer": 1}))
            await asyncio.to_thread(b.says, "device online")
        assert await asyncio.to_thread(b.ended) == 1
        assert b.has_said("gateway left serves every device of this file already")
        await p.until_alive("left/alive/mixer")
        async with asyncio.timeout(TIMEOUT):  # so long it refuses what may be of the past
            while not (await p.client.get(RECIPE, b"7", target="ALL"))[0].ok:
                await asyncio.sleep(POLL)
