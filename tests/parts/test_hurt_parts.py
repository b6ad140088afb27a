"""Parts that fail or hang in a real gateway, and files that hang: values flow, writes are done."""

import asyncio
import os
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from gateway.parts.registry import PARTS
from tests.e2e.processes import PATIENCE, Program, free_port, write_config
from tests.zenoh_peer import POLL, Subscription, ZenohPeer, free_endpoint

POLLED = 0.05  # seconds: a status document has no notice
OWN, SET = "plant/@gateway/demo", "plant/mixer/recipe/@set"


class Plant:
    """A gateway with every part, and a client."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint, self.port = free_endpoint(), free_port()
        self.served, self.door = free_port(), free_port()
        self.changes = 0
        (folder / "tokens").write_text("ana:a-token-that-is-long-enough\n")
        (folder / "tokens").chmod(0o600)
        (folder / "tags.csv").write_text("name,address\nlevel,D1\n")
        (folder / "templates.yaml").write_text("templates: {}\n")
        self.config = self.write()

    def write(self) -> Path:
        """Writes the file, changed in one tag."""
        self.changes += 1
        tags = {
            "level": {"address": "D10", "publish": "always", "alarm": {"high": -1}},
            "recipe": {"address": "D500", "write": True},
            "copy": {"address": "D501", "write": True},
            "more": {"address": "D20", "scale": self.changes},
        }
        served = {"level": {"address": "holding:0", "source": "mixer/level", "hold_last": True}}
        served["held"] = {"address": "holding:10", "write": True, "retain": True}
        vigor = {"protocol": "vigor", "station": 1, "reply_timeout": "5s"}
        lines = {
            "hall": {"port": "simulator", "devices": {"mixer": {**vigor, "tags": tags}}},
            "yard": {"port": "simulator", "devices": {"press": {**vigor, "tags_from": "tags.csv"}}},
            "panel": {
                "port": f"tcp://127.0.0.1:{self.served}",
                "serve": True,
                "devices": {"hmi": {"protocol": "modbus-tcp", "tags": served}},
            },
        }
        door = {"line": "hall", "listen": f"127.0.0.1:{self.door}", "protocol": "vigor"}
        return write_config(
            self.folder / "plant.yaml",
            self.endpoint,
            lines,
            gateway={"name": "demo", "state": "state.json", "audit": "audit.jsonl"},
            web={"listen": f"127.0.0.1:{self.port}", "tokens_file": "tokens"},
            history={"path": "history.db"},
            alarms={"path": "alarms.json"},
            notify={"command": ["/bin/true"], "rules": [{"to": ["command"]}]},
            templates_from="templates.yaml",
            defaults={"every": "100ms", "history": True},
            share={"doors": {"laptop": door}},
            transfers=[{"from": "mixer/level", "to": "mixer/copy", "every": "1h"}],
        )


@asynccontextmanager
async def running(folder: Path, orders: str = "") -> AsyncIterator["Running"]:
    plant = Plant(folder)
    command = (sys.executable, "-m", "tests.parts.hurt", "run", plant.config, orders)
    with Program(*command) as program:
        await asyncio.to_thread(program.says, "Zenoh session ready")
        async with ZenohPeer("client", connect=[plant.endpoint]) as client:
            heard = await client.subscribe("plant/mixer/level")
            yield Running(plant, program, client, heard)


class Running:
    def __init__(
        self, plant: Plant, program: Program, client: ZenohPeer, heard: Subscription
    ) -> None:
        self.plant, self.program, self.client, self.heard = plant, program, client, heard

    async def tell(self, order: str) -> None:
        await asyncio.to_thread(self.program.tell, order)

    async def works(self) -> None:
        """Values flow, and a write is acknowledged."""
        self.heard.forget()
        await self.heard.next(lambda sample: bool(sample.json["quality"] == "good"), PATIENCE)
        async with asyncio.timeout(PATIENCE):
            while not all(one.ok for one in await self.client.get(SET, b"7", PATIENCE)):
                await asyncio.sleep(POLL)  # a slow machine may refuse one: it stood still
        assert not self.program.has_said("THE LOOP IS HELD")

    async def document(self, path: str) -> dict[str, Any]:
        async with asyncio.timeout(PATIENCE):
            while True:  # a slow machine may refuse a query: it stood still
                for reply in await self.client.get(f"{OWN}/{path}", timeout=PATIENCE):
                    if reply.ok:
                        found: dict[str, Any] = reply.json
                        return found

    async def why(self, name: str) -> str:
        """Returns why the part does not work; empty: it does."""
        return str((await self.document(f"parts/{name}"))["why"])

    async def until_said(self, name: str, why: str) -> None:
        """Waits until the status says why the part does not work; empty: it does."""

        def is_said(said: str) -> bool:
            return why in said if why else not said

        async with asyncio.timeout(PATIENCE):
            while not is_said(await self.why(name)):
                await asyncio.sleep(POLLED)

    async def until_stopped(self, name: str, why: str, first: int = 0) -> None:
        """Waits for the entry of the log, after so many lines."""
        words = ("part stopped", f"part={name} ", why)
        await asyncio.to_thread(partial(self.program.says, *words, after=first))

    async def reload(self, *, wait: bool = True) -> None:
        before = await self.reloads()
        self.plant.write()
        os.kill(self.program.pid, signal.SIGHUP)
        while wait and await self.reloads() == before:
            await asyncio.sleep(POLLED)

    async def reloads(self) -> int:
        return int((await self.document("reload"))["reloads"])


# By part: the points of its life that a running gateway reaches. A reload calls the last three.
RELOADED = {"retag", "take_over"}
POINTS = {
    "history": ("run", "publish", "documents"),
    "audit": ("run", "documents"),
    "state": ("run",),
    "serving": ("run", "seen", "documents"),
    "doors": ("run", "documents", "take_over"),
    "transfers": ("run", "publish", "documents", "take_over"),
    "alarms": ("run", "seen", "documents", "retag", "take_over"),
    "notify": ("run", "documents"),
    "damaged_files": ("run", "documents", "faults"),
    "web": ("run",),
}
QUIET = {"certificates", "remote"}  # the file of this plant does not want them


def test_every_part_is_hurt() -> None:
    assert {*POINTS, *QUIET} == {*PARTS}


@pytest.mark.parametrize("name", POINTS)
async def test_a_part_fails_is_said_and_comes_back(name: str, tmp_path: Path) -> None:
    async with running(tmp_path) as plant:
        for point in POINTS[name]:
            first = len(plant.program.lines)
            await plant.tell(f"break {name} {point}")
            if point in RELOADED:
                await plant.reload()
            else:
                await plant.until_said(name, f"broken in {point}")
            await plant.until_stopped(name, f"broken in {point}", first)
            await plant.works()
            await plant.tell("mend")
            await plant.until_said(name, "")
        await plant.tell(f"break {name} make")
        await plant.tell(f"break {name} run")
        await plant.until_said(name, "broken in make")
        await plant.works()
        await plant.tell("mend")
        await plant.until_said(name, "")
        await plant.works()


@pytest.mark.parametrize(
    "orders",
    [
        "break all run",
        "break all begin,break all restore",
        "hang all begin,hang all restore,hang all publish_all",
    ],
)
async def test_the_plant_starts_while_every_part_is_hurt(orders: str, tmp_path: Path) -> None:
    async with running(tmp_path, orders) as plant:
        await plant.works()
        await plant.tell("mend")
        for name in POINTS:
            if not (name == "state" and "restore" in orders):  # its file is left as it was
                await plant.until_said(name, "")
        await plant.works()
        assert await asyncio.to_thread(plant.program.end) == 0


async def test_the_plant_goes_on_while_every_part_hangs_in_a_reload(tmp_path: Path) -> None:
    async with running(tmp_path) as plant:
        await plant.tell("hang all take_over")
        await plant.reload(wait=False)
        for name in ("alarms", "transfers"):
            await plant.until_stopped(name, "it did not answer within 5 s")
            await plant.works()
        await plant.tell("mend")
        for name in ("alarms", "transfers"):
            await plant.until_said(name, "")
        await plant.reload()
        await plant.tell("hang all stop")
        await plant.works()
        assert await asyncio.to_thread(plant.program.end) == 0


async def test_each_file_hangs_and_nothing_else_does(tmp_path: Path) -> None:
    files = (
        "plant.yaml",
        "tokens",
        "tags.csv",
        "templates.yaml",
        "history.db",
        "state.json",
        "alarms.json",
        "notify.json",
        "audit.jsonl",
        "hmi",
        "",
    )
    async with running(tmp_path) as plant:
        for file in files:
            await plant.tell(f"hold {tmp_path / file}")
            before = await plant.reloads()
            await plant.reload(wait=False)
            await plant.works()
            await plant.tell("mend")
            async with asyncio.timeout(PATIENCE):
                while await plant.reloads() == before:
                    await asyncio.sleep(POLLED)
        await plant.works()
