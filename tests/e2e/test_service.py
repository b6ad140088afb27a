"""What a gateway does with its files and its wire: begun twice, begun again, with a broken part."""

import asyncio
import json
import socket
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.processes import (
    Program,
    free_port,
    gateway,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {f"d{n}": {"address": f"D{n}"} for n in range(700, 708)}
# The command itself; only that the state is written at once when there is news.
SOON = "import gateway.service as s; s.KEEP_EVERY = 0.05; from gateway.cli import main; main()"
# The command itself, with a history that can keep nothing.
BROKEN = """
from gateway.history import Historian
def record(self, samples): raise IndexError("the history is broken")
Historian.record = record
from gateway.cli import main; main()
"""


class Wire:
    """A device server that nobody answers from: whether anybody connected."""

    def __init__(self) -> None:
        self.touched = False

    async def serve(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.touched = True
        writer.close()


@asynccontextmanager
async def wire(number: int) -> AsyncIterator[Wire]:
    found = Wire()
    async with await asyncio.start_server(found.serve, "127.0.0.1", number):
        yield found


@contextmanager
def taken(endpoint: str) -> Iterator[None]:
    """As a gateway that runs already has it."""
    with socket.create_server(("127.0.0.1", int(endpoint.rpartition(":")[2]))):
        yield


@pytest.mark.parametrize("mode", ["peer", "router"])
async def test_a_gateway_started_twice_touches_neither_wire_nor_file(
    tmp_path: Path, mode: str
) -> None:
    endpoint, number = free_endpoint(), free_port()
    path = write_config(
        tmp_path / "config.yaml",
        "",
        {"hall": vigor_line(f"tcp://127.0.0.1:{number}", TAGS)},
        gateway={"name": "demo", "state": "state.json"},
        zenoh={"mode": mode, "listen": [endpoint]},
        defaults={"history": True},
        history={"path": "history.db"},
    )
    async with wire(number) as line:
        with taken(endpoint), gateway("run", path) as second:
            assert await asyncio.to_thread(second.ended) == 1
            second.says("perhaps this gateway is running already")
        assert not line.touched
    assert list(tmp_path.iterdir()) == [path]


def test_a_client_keeps_history_while_it_waits_for_its_router(tmp_path: Path) -> None:
    path = write_config(
        tmp_path / "config.yaml",
        "",
        {"hall": vigor_line("simulator", TAGS)},
        zenoh={"mode": "client", "listen": [], "connect": [free_endpoint()]},
        defaults={"history": True},
        history={"path": "history.db"},
    )
    with gateway("run", path) as program:
        program.says("no Zenoh router yet")
        program.says("history is written")
        program.says("device answers")
        assert program.end() == 0


def _plant(folder: Path) -> tuple[Path, str, Path]:
    endpoint, state = free_endpoint(), folder / "state.json"
    path = write_config(
        folder / "config.yaml",
        endpoint,
        {"hall": vigor_line(str(folder / "tty"), TAGS)},
        gateway={"name": "demo", "state": state.name},
    )
    return path, endpoint, state


def _refused(state: Path) -> list[int]:
    """Which addresses the file knows."""
    if not state.exists():
        return []
    known = json.loads(state.read_bytes())["devices"]["mixer"]["refused"]
    return [row["start"] for row in known]


async def _searched(endpoint: str) -> Any:
    """The device's status once all its tags but D703 are good."""
    async with ZenohPeer("client", connect=[endpoint]) as client:
        while True:
            values = await client.get("plant/mixer/*", consolidation="NONE")
            bad = [value.key for value in values if value.json["quality"] == "bad"]
            [device] = await client.get("plant/@gateway/demo/devices/mixer")
            if bad == ["plant/mixer/d703"] and device.json["refused_addresses"]:
                return device.json


async def test_refused_addresses_are_known_after_a_restart(tmp_path: Path) -> None:
    path, endpoint, state = _plant(tmp_path)
    with station("pty", str(tmp_path / "tty")) as plc:
        plc.tell("hole 1 D 703")
        with started(path) as first:
            before = await _searched(endpoint)
            assert await asyncio.to_thread(first.end) == 0
        assert _refused(state) == [703]
        with started(path) as second:
            after = await _searched(endpoint)
            assert await asyncio.to_thread(second.end) == 0
    assert after["refused_addresses"] == before["refused_addresses"]  # since the same time
    assert before["refusals"]["28"] >= 3  # of eight, four and two registers at least
    assert after["refusals"].get("28", 0) <= 1


async def test_what_was_learned_is_written_while_the_gateway_runs(tmp_path: Path) -> None:
    path, _, state = _plant(tmp_path)
    with station("pty", str(tmp_path / "tty")) as plc:
        plc.tell("hole 1 D 703")
        with Program(sys.executable, "-c", SOON, "run", path) as program:
            program.says("on Zenoh")
            until(lambda: _refused(state) == [703], "the file knows D703")
            assert program.running


async def test_a_history_that_fails_keeps_nothing_from_being_published(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = write_config(
        tmp_path / "config.yaml",
        endpoint,
        {"hall": vigor_line("simulator", {"speed": {"address": "D10", "publish": "always"}})},
        defaults={"every": "50ms", "history": True},
        history={"path": str(tmp_path / "history.db")},
    )
    with Program(sys.executable, "-c", BROKEN, "run", path) as program:
        program.says("on Zenoh")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe("plant/mixer/speed")
            for _ in range(3):
                await heard.next(lambda sample: sample.json["quality"] == "good")
                heard.forget()
        assert not program.has_said("line failed")
        assert await asyncio.to_thread(program.end) == 0
