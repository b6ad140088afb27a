"""A TCP peer that loses its power sends neither FIN nor RST.

The PLC runs in a network namespace behind a virtual cable, which the test unplugs. The long
time-outs of the gateway are shorter here.
"""

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import forbidden, needs
from tests.e2e.processes import PATIENCE, Program, station, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

PORT = 4001
SPEED = "plant/mixer/speed"


class Cable:
    """A cable to a network namespace; unplugged, it loses all packets."""

    def __init__(self, ip: str) -> None:
        number = os.getpid()
        self._ip = ip
        self.name = f"plc{number}"
        self.peer = f"198.18.{number % 250}.2"
        self._near, self._far = f"n{number}", f"f{number}"
        self._run("netns", "add", self.name)
        try:
            self._run(
                *("link", "add", self._near, "type", "veth", "peer", "name", self._far),
                *("netns", self.name),
            )
            self._run("addr", "add", f"198.18.{number % 250}.1/30", "dev", self._near)
            self._run("link", "set", self._near, "up")
            self._run("-n", self.name, "addr", "add", f"{self.peer}/30", "dev", self._far)
            self.plug()
        except BaseException:
            self.remove()
            raise

    def _run(self, *words: str) -> None:
        subprocess.run([self._ip, *words], check=True, capture_output=True, timeout=PATIENCE)

    def plug(self) -> None:
        self._run("-n", self.name, "link", "set", self._far, "up")

    def pull(self) -> None:
        self._run("-n", self.name, "link", "set", self._far, "down")

    def station(self) -> Program:
        """Runs a simulated PLC at the far end."""
        return station("tcp", f"{self.peer}:{PORT}", by=(self._ip, "netns", "exec", self.name))

    def remove(self) -> None:
        self._run("netns", "del", self.name)


@pytest.fixture
def cable() -> Iterator[Cable]:
    ip = needs("ip")
    try:
        cable = Cable(ip)
    except subprocess.CalledProcessError as error:
        forbidden(f"no network namespace may be made here: {error.stderr.decode().strip()}")
    yield cable
    cable.remove()


async def test_a_peer_without_power_is_detected_and_comes_back(
    cable: Cable, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    tags = {
        "speed": {"address": "D10", "publish": "always"},
        "recipe": {"address": "D500", "write": True},
    }
    line = vigor_line(f"tcp://{cable.peer}:{PORT}", tags) | {"connection": {"keepalive": "1s"}}
    config = write_config(tmp_path / "config.yaml", endpoint, {"hall": line})
    with (
        cable.station() as plc,
        Program(sys.executable, "-m", "gateway", "run", config) as service,
    ):
        plc.tell("set 1 D 10 5")
        await asyncio.to_thread(service.says, "Zenoh session ready")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe("plant/mixer/*")
            await heard.next(_is(5))

            # For a moment: TCP sends again what was lost, and what is late does no harm.
            heard.forget()
            cable.pull()
            told = await heard.next(_bad)
            assert told.json["reason"] == "no-reply"
            [answer] = await client.get("plant/mixer/recipe/@set", b"7")
            assert answer.json["error"] in ("no-reply", "unclear", "line-down")
            unclear = answer.json["error"] == "unclear"
            heard.forget()
            cable.plug()
            await heard.next(_is(5))
            assert plc.tell("get 1 D 500") == "0" or unclear

            # For good: no reply comes, so the line is down. Another station starts later.
            heard.forget()
            cable.pull()
            assert (await heard.next(_bad)).json["reason"] == "no-reply"
            assert "why=" in await asyncio.to_thread(service.says, "line down")
            await heard.next(lambda h: _bad(h) and h.json["reason"] == "line-down")
            [answer] = await client.get("plant/mixer/recipe/@set", b"8")
            assert answer.json["error"] == "line-down"
            plc.end(signal.SIGKILL)
            heard.forget()
            with await asyncio.to_thread(cable.station) as again:
                again.tell("set 1 D 10 6")
                cable.plug()
                await heard.next(_is(6))
                assert again.tell("get 1 D 500") == "0"
                [done] = await client.get("plant/mixer/recipe/@set", b"9")
                assert done.ok
                assert again.tell("get 1 D 500") == "9"
        assert not service.has_said("Traceback")


def _is(value: int) -> Callable[[Any], bool]:
    return lambda heard: heard.key == SPEED and heard.json["value"] == value


def _bad(heard: Any) -> bool:
    return heard.key == SPEED and bool(heard.json["quality"] == "bad")
