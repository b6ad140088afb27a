"""A gateway started twice, restarted, or with a failing part."""

import asyncio
import json
import socket
import sys
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from gateway.config import load
from gateway.northbound.requests.inbox import Inbox
from gateway.parts.history.historian import Historian
from gateway.parts.history.part import HistoryPart
from gateway.plant.part import Phase
from gateway.plant.plant import Plant
from gateway.service import service
from gateway.tags import Sample, good
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
from tests.history_writer import WEEK
from tests.history_writer import until as history_says
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {f"d{n}": {"address": f"D{n}"} for n in range(700, 708)}
# The command itself, with a state file that is written more often.
SOON = (
    "import gateway.parts.state.part as s; s.SAVE_EVERY = 0.05; "
    "from gateway.cli.main import main; main()"
)
# The same, with a disk that never ends a write.
STALLED = """
import threading
from gateway.plant.saved_file import SavedFile
def save(self, snapshot): print("saving", flush=True); threading.Event().wait()
SavedFile.save = save
"""
# The command itself, with a history that fails at the first sample.
BROKEN = """
from gateway.parts.history.store.file import HistoryFile
def store(self, run, start, samples): raise IndexError("the history is broken")
HistoryFile.store = store
from gateway.cli.main import main; main()
"""


class Wire:
    """A device server without a PLC. `touched`: a client has connected."""

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
    """Keeps the port of the endpoint, as a running gateway does."""
    with socket.create_server(("127.0.0.1", int(endpoint.rpartition(":")[2]))):
        yield


@pytest.mark.parametrize("mode", ["peer", "router"])
async def test_a_gateway_started_twice_uses_neither_wire_nor_file(
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
    assert [each for each in tmp_path.iterdir() if each.suffix != ".lock"] == [path]


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
        program.says("Zenoh router unreachable")
        program.says("history ready")
        program.says("device online")
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
    """Returns the bad addresses in the file."""
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


async def test_bad_addresses_are_known_after_a_restart(tmp_path: Path) -> None:
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


async def test_the_state_file_is_written_while_the_gateway_runs(tmp_path: Path) -> None:
    path, _, state = _plant(tmp_path)
    with station("pty", str(tmp_path / "tty")) as plc:
        plc.tell("hole 1 D 703")
        with Program(sys.executable, "-c", SOON, "run", path) as program:
            program.says("Zenoh session ready")
            until(lambda: _refused(state) == [703], "the file knows D703")
            assert program.running


async def test_a_failing_history_does_not_stop_publishing(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = write_config(
        tmp_path / "config.yaml",
        endpoint,
        {"hall": vigor_line("simulator", {"speed": {"address": "D10", "publish": "always"}})},
        defaults={"every": "50ms", "history": True},
        history={"path": str(tmp_path / "history.db")},
    )
    with Program(sys.executable, "-c", BROKEN, "run", path) as program:
        program.says("Zenoh session ready")
        program.says("history has failed")
        async with ZenohPeer("client", connect=[endpoint]) as client:
            heard = await client.subscribe("plant/mixer/speed")
            for _ in range(3):
                await heard.next(lambda sample: sample.json["quality"] == "good")
                heard.forget()
        assert not program.has_said("line failed")
        assert await asyncio.to_thread(program.end) == 0


async def test_a_published_value_is_found_by_the_next_query(tmp_path: Path) -> None:
    """In one pass of the loop a line has a sample, and then the inbox takes the queries."""
    lines = {"hall": vigor_line("simulator", {"speed": {"address": "D10", "history": True}})}
    path = write_config(tmp_path / "config.yaml", free_endpoint(), lines, history={"path": "h.db"})
    whole = Plant(load(path))
    speed = whole.tag("mixer/speed")
    assert speed is not None
    found: dict[str, list[object]] = {}

    def answer(query: str, _at: float) -> None:
        found[query] = [sample.value for sample in historian.samples(speed, "[..]", None)]

    class Network:
        def publish(self, samples: Sequence[Sample]) -> None:
            inbox("after the sample")

        def set_online(self, device: str, online: bool) -> None: ...

    historian = Historian(tmp_path / "h.db", WEEK, 10**8)
    historian.start()
    await asyncio.to_thread(history_says, historian, state="ok")
    inbox = Inbox(answer, lambda _: None)
    whole.subscribe(Network())
    whole.subscribe(HistoryPart(whole, historian))  # after Zenoh, as the service does
    asyncio.get_running_loop().call_soon(whole.samples, [good(speed, 1, time.time_ns())])
    inbox("before the sample")  # the inbox takes both in the same turn of the loop
    for _ in range(3):
        await asyncio.sleep(0)
    assert found == {"before the sample": [1], "after the sample": [1]}
    assert await asyncio.to_thread(historian.close)


def test_a_stalled_disk_does_not_delay_the_end(tmp_path: Path) -> None:
    path, _, _ = _plant(tmp_path)
    with Program(sys.executable, "-c", STALLED + SOON, "run", path) as program:
        program.says("saving")
        assert program.end() == 0
        assert program.has_said("state file close timed out")
        assert not program.has_said("Traceback")


async def test_the_files_get_the_time_that_zenoh_leaves() -> None:
    """The gateway ends within 2 s in all."""
    zenoh_takes, given = 0.3, list[float]()

    class Files:
        async def stop(self, *phases: Phase, within: float) -> None:
            given.append(within)

    async def zenoh() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(zenoh_takes)

    files: Any = Files()
    zenoh_task = asyncio.create_task(zenoh())
    await asyncio.sleep(0)
    # Private: the order and the times of the end are the subject; `run` needs signals and ports.
    await service._close(zenoh_task, files)
    assert given[0] <= service.END_WITHIN - zenoh_takes < 2
