"""`archive run` beside gateways: what is in their histories is in the store, once."""

import asyncio
import json
import signal
import sqlite3
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
import pytest
from pyarrow import dataset, fs

from gateway.archive.store import Cursor
from gateway.archive.stores import store_at
from tests.conftest import Command
from tests.e2e.processes import (
    Program,
    gateway,
    started,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

Sample = tuple[str, int, str | None]  # gateway and key, microseconds, reason
Found = Counter[Sample]

TAGS: dict[str, dict[str, Any]] = {
    "speed": {"address": "D100"},
    "total": {"address": "D110", "type": "uint64"},
    "name": {"address": "D120", "type": "string[4]"},
    "raw": {"address": "D130", "type": "string[4]", "payload": "raw"},
    "steps": {"address": "D140", "type": "int16[3]"},
}


def archiver(store: object, endpoint: str, *options: object) -> Program:
    where = ("--connect", endpoint, "--every", 0.1)
    return gateway("archive", "run", store, *where, *options)


def recorded(history: Path, gateway: str) -> Found:
    """Returns what a gateway has on its disk."""
    with closing(sqlite3.connect(history)) as database:
        rows = database.execute("SELECT key, time / 1000, bad FROM history").fetchall()
    return Counter((f"{gateway} plant/{key.partition('@')[0]}", at, bad) for key, at, bad in rows)


def archived(store: object) -> Found:
    """Returns what is in Parquet files, in a folder or on S3."""
    files, root = fs.FileSystem.from_uri(str(store))
    columns = ["gateway", "key", "time", "reason"]
    for left in reversed(range(50)):
        try:
            found = dataset.dataset(root, filesystem=files, partitioning="hive", format="parquet")
            rows = found.to_table(columns).to_pydict().values() if found.files else ()
        except (OSError, pa.ArrowException):  # the archiver replaced a part meanwhile
            if not left:
                raise
        else:
            break
    return Counter(
        (f"{gateway.rpartition(',')[2]} {key}", round(time.timestamp() * 1e6), reason)
        for gateway, key, time, reason in zip(*rows, strict=True)
    )


def cursors(store: object) -> dict[str, Cursor]:
    """Returns the cursors by the names of the gateways."""
    with closing(store_at(str(store))) as opened:
        return {key.rpartition("/")[2]: cursor for key, cursor in opened.cursors().items()}


def samples(store: object) -> dict[str, int]:
    return {name: cursor.samples for name, cursor in cursors(store).items()}


class Hall:
    """A gateway with a simulated PLC. `idle`: it polls nothing."""

    def __init__(self, folder: Path, name: str, endpoint: str, **how: Any) -> None:
        self.folder, self.name = folder / name, name
        self.folder.mkdir()
        self.history = self.folder / "history.db"
        self._endpoint, self._how = endpoint, how

    def run(self, *, idle: bool = False) -> Program:
        device = {"protocol": "vigor", "station": 1, "enabled": not idle, "tags": TAGS}
        lines = {"hall": {"port": "simulator", "devices": {f"{self.name}-plc": device}}}
        file = write_config(
            self.folder / "c.yaml",
            self._endpoint,
            lines,
            gateway={"name": self.name},
            zenoh={"prefix": "plant", "listen": [], "connect": [], **self._how},
            defaults={"every": "50ms", "history": True},
            history={"path": "history.db"},
        )
        return started(file)


def have_all(store: Path, halls: list[Hall]) -> Callable[[], bool]:
    def check() -> bool:
        truth = sum((recorded(hall.history, hall.name) for hall in halls), Found())
        return archived(store) == truth

    return check


def test_histories_of_two_gateways_are_in_parquet_once_whatever_happens(
    command: Command, tmp_path: Path
) -> None:
    """Archivers take over from each other; a history is moved aside, and comes back."""
    endpoint, store = free_endpoint(), tmp_path / "archive"
    demo = Hall(tmp_path, "demo", endpoint, listen=[endpoint])
    other = Hall(tmp_path, "other", endpoint, connect=[endpoint], mode="client")
    with ExitStack() as ends:
        gateways = [ends.enter_context(hall.run()) for hall in (demo, other)]
        first = ends.enter_context(archiver(store, endpoint))
        first.says("this archiver is at work")
        first.says("plant/@gateway/other: archived after the beginning")
        second = ends.enter_context(archiver(store, endpoint))
        second.says("another archiver of this store is at work: this one waits")
        until(lambda: samples(store).keys() == {"demo", "other"}, "both gateways are archived")
        first.end(signal.SIGKILL)
        second.says("this archiver is at work")
        before = samples(store)["demo"]
        until(lambda: samples(store)["demo"] > before, "it goes on")
        second.end(signal.SIGKILL)
        # Killed ones would lose samples of 0.1 s, which the archive may have.
        assert [program.end() for program in gateways] == [0, 0]

    with demo.run(idle=True), other.run(idle=True), archiver(store, endpoint) as third:
        until(have_all(store, [demo, other]), "each sample is there once")
        assert third.end() == 0
    [row, _] = map(json.loads, command("archive", "status", store, "--json").out.splitlines())
    assert row["samples"] == recorded(demo.history, "demo").total()
    assert (row["gateway"], row["gaps"]) == ("plant/@gateway/demo", [])
    assert row["behind"] < 3600

    aside = demo.history.rename(f"{demo.history}.aside-20261126T120000Z")
    with demo.run() as running, archiver(store, endpoint) as fourth:
        fourth.says("its history is another file")
        assert (running.end(), fourth.end()) == (0, 0)
    assert command("history", "salvage", demo.folder / "c.yaml").code == 0
    assert not aside.exists()
    with demo.run(idle=True), archiver(store, endpoint) as fifth:
        fifth.says("its history is another file")
        until(have_all(store, [demo, other]), "nothing is there twice")
        assert fifth.end() == 0  # the cursor with the gap is stored after the samples
    rows = duckdb.execute(
        f"SELECT DISTINCT origin, typeof(value) FROM '{store}/*/*/*.parquet'"  # noqa: S608
    ).fetchall()
    assert ("simulated", "DOUBLE") in rows
    shown = command("archive", "status", store)
    assert "plant/@gateway/other" in shown.out
    assert "its history is another file: samples may be missing" in shown.out


def test_a_gateway_without_history_is_named_once(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    line = vigor_line("simulator", {"speed": {"address": "D100"}})
    file = write_config(tmp_path / "c.yaml", endpoint, {"hall": line})
    with started(file), archiver(tmp_path / "archive", endpoint) as program:
        program.says("plant/@gateway/demo: no-history: no history is kept here")
        assert program.end() == 0


async def test_the_page_of_a_gateway_has_its_samples_only(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with await asyncio.to_thread(Hall(tmp_path, "demo", endpoint, listen=[endpoint]).run):
        async with ZenohPeer("client", connect=[endpoint]) as client:
            await client.get_until("plant/demo-plc/speed", lambda known: known["quality"] == "good")
            selector = "plant/@gateway/demo/page?_time=[..];page=1000"
            *batches, end = await client.get(selector, accept_replies="ANY")
            assert end.key == "plant/@gateway/demo/page"
            assert {one.key for one in batches} == {"plant/@gateway/demo/page/samples"}
            samples = [
                one
                for found in batches
                for one in zip(found.json["keys"], found.json["values"], strict=True)
            ]
            assert end.json["samples"] == len(samples) > 5
            assert all(key.startswith("plant/demo-plc/") for key, _ in samples)
            bare = [known for key, known in samples if key == "plant/demo-plc/raw"]
            assert bare
            assert all("quality" in known for known in bare)


@pytest.mark.parametrize("option", [("--every", "0"), ("--rate", "0"), ("--rate", "x")])
def test_wrong_options_are_refused(
    command: Command, option: tuple[str, str], tmp_path: Path
) -> None:
    done = command("archive", "run", tmp_path / "archive", *option)
    assert done.code == 2
    assert option[0] in done.err


def test_a_clock_that_was_ahead_hides_no_delay(command: Command, tmp_path: Path) -> None:
    """It has noted a time of next year: nothing was `behind` until then."""
    store = store_at(str(tmp_path / "archive"))
    ahead = round((time.time() + 3e7) * 1e6)
    begun = Cursor("plant/@gateway/demo")
    store.add([], begun, replace(begun, after="demo:1f.a0-1-2", whole=ahead))
    shown = command("archive", "status", tmp_path / "archive", "--json")
    assert shown.json["behind"] is None
