"""A clock that is ten years ahead, and damage: what was recorded stays, or comes back."""

import asyncio
import csv
import io
import sqlite3
import time
from contextlib import closing
from pathlib import Path

from gateway.parts.history.store.file import HistoryFile
from gateway.tags import good
from tests.attacks.test_clock_of_signatures import run, set_clock
from tests.conftest import Command
from tests.e2e.processes import plc_gateway, started, write_config
from tests.history.recorded import SECOND, store_run
from tests.history_writer import tag
from tests.zenoh_peer import ZenohPeer, free_endpoint

RUNS, IN_RUN = 5, 400
YEARS = 3650 * 86400  # seconds
EXPORT = ("history", "export", "--time", "[..]")
DOCUMENT = "plant/@gateway/demo/history"
SPEED, TEXT = tag("speed").with_origin("simulated"), tag("text").with_origin("simulated")


def plant(folder: Path, endpoint: str) -> Path:
    """Its mixer is recorded already, and disabled; the oven is polled often."""
    begin = time.time_ns() - 3600 * SECOND
    with closing(HistoryFile(folder / "history.db", 10**7)) as file:
        for one in range(RUNS):
            numbers = range(one * IN_RUN, (one + 1) * IN_RUN)
            store_run(file, [good(SPEED, n, begin + n * SECOND) for n in numbers])
        store_run(file, [good(TEXT, "=cmd", begin)])
    tags = {"speed": {"address": "D1"}, "text": {"address": "D2", "type": "string[8]"}}
    mixer = {"protocol": "vigor", "enabled": False, "tags": tags}
    oven = {"protocol": "vigor", "station": 2, "tags": {"heat": {"address": "D1"}}}
    lines = {"hall": {"port": "simulator", "devices": {"mixer": mixer, "oven": oven}}}
    return write_config(
        folder / "plant.yaml",
        endpoint,
        lines,
        defaults={"every": "20ms", "history": True, "publish": "always"},
        history={"path": "history.db", "keep": "1d", "max_size": "10MB"},
    )


def speeds(exported: str) -> list[str]:
    """Returns the good samples of the mixer's speed."""
    rows = csv.DictReader(io.StringIO(exported))
    return [row["value"] for row in rows if (row["tag"], row["quality"]) == (SPEED.key, "good")]


EVERY = [str(n) for n in range(RUNS * IN_RUN)]


async def test_a_clock_ten_years_ahead_for_a_moment_costs_no_sample(
    command: Command, tmp_path: Path
) -> None:
    file = plant(tmp_path, endpoint := free_endpoint())
    with await asyncio.to_thread(run, file, YEARS) as program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            # With its first samples it looks at the age of the oldest.
            ahead = await client.get_until(DOCUMENT, lambda one: one["stored"] > 10)
            set_clock(tmp_path, program, 0)
            await client.get_until(DOCUMENT, lambda one: one["stored"] > ahead["stored"] + 10)
        assert await asyncio.to_thread(program.end) == 0
    assert speeds(command(*EXPORT, file).out) == EVERY


async def moved_aside(file: Path, endpoint: str) -> int:
    """Starts the gateway. Returns how many histories were moved aside; each is a fault."""
    with await asyncio.to_thread(started, file) as program:
        async with ZenohPeer("client", connect=[endpoint]) as client:
            found = await client.get_until(DOCUMENT, lambda one: one["state"] == "ok")
        done = await asyncio.to_thread(plc_gateway, "status", file)
        assert done.code == int(bool(found["aside"]))
        assert ("was moved aside" in " ".join(done.out.split())) == bool(found["aside"])
        assert await asyncio.to_thread(program.end) == 0
    return len(found["aside"])


async def test_a_damaged_history_is_a_fault_until_its_samples_are_back(
    command: Command, tmp_path: Path
) -> None:
    file = plant(tmp_path, endpoint := free_endpoint())
    with (path := tmp_path / "history.db").open("r+b") as first_page:
        first_page.write(b"\xa5" * 4096)
    assert await moved_aside(file, endpoint) == 1
    assert speeds(command(*EXPORT, file).out) == []
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE file SET oldest = 9223372036854775807")
    assert await moved_aside(file, endpoint) == 2
    done = command("history", "salvage", file)
    assert (done.code, "samples are back" in done.err) == (0, True)
    assert await moved_aside(file, endpoint) == 0
    (tmp_path / "rows.csv").symlink_to(tmp_path / "of another user")
    exported = command(*EXPORT, file, "--output", tmp_path / "rows.csv")
    assert (exported.code, (tmp_path / "of another user").exists()) == (0, False)
    rows = (tmp_path / "rows.csv").read_text()
    assert speeds(rows) == EVERY
    assert ",'=cmd," in rows
