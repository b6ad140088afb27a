"""Router and gateway killed under load: a consumer gets every sample of the history once."""

import asyncio
import signal
import sqlite3
import sys
import time
from collections import Counter
from contextlib import AsyncExitStack, closing
from pathlib import Path
from typing import Any

from gateway.config import ZenohMode
from gateway.tags.timestamps import rfc3339
from tests.e2e.processes import (
    ROOT,
    Program,
    slowed,
    started,
    station,
    until,
    vigor_line,
    write_config,
)
from tests.zenoh_peer import ZenohPeer, free_endpoint

WITHIN = 2.0  # seconds from SIGTERM to the end
WRITES = 20
Row = tuple[str, str, str]  # time, key and value, as the consumer prints them


class Consumer:
    """examples/catch_up.py with all tags."""

    def __init__(self, program: Program) -> None:
        self._program = program

    @property
    def rows(self) -> list[Row]:
        words = [line.split(maxsplit=2) for line in list(self._program.lines) if line[:2] == "20"]
        return [(when, key, value.removesuffix(" late")) for when, key, value in words]

    async def goes_on(self, rows: int) -> None:
        """Waits for more samples."""
        wanted = len(self.rows) + rows
        await asyncio.to_thread(until, lambda: len(self.rows) >= wanted, "the consumer goes on")


def kept(path: Path) -> list[Row]:
    """Returns the rows of the file, and checks that it is intact."""
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        rows = database.execute("SELECT time, key, value FROM history ORDER BY time").fetchall()
    return [(rfc3339(when), f"plant/{key}", str(value)) for when, key, value in rows]


async def test_history_survives_router_and_gateway_killed_under_load(tmp_path: Path) -> None:
    """The line is overloaded, and a client writes."""
    endpoint, tty = free_endpoint(), str(tmp_path / "tty")
    history = tmp_path / "history.db"
    tags: dict[str, Any] = {f"v{n}": {"address": f"D{10 + n}"} for n in range(40)}
    tags |= {f"w{n}": {"address": f"D{3000 + n}", "write": True} for n in range(WRITES)}
    tags["last"] = {"address": "D500", "write": True}
    config = write_config(
        tmp_path / "config.yaml",
        "",
        {"hall": vigor_line(tty, tags, reply_timeout="5s")},
        zenoh={"mode": "client", "prefix": "plant", "listen": [], "connect": [endpoint]},
        defaults={"every": "50ms", "publish": "always", "history": True},
        history={"path": str(history)},
    )
    async with AsyncExitStack() as stack:
        plc = stack.enter_context(station("pty", tty))
        plc.tell("count 1 D 10")
        router = await stack.enter_async_context(ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]))
        first = stack.enter_context(await asyncio.to_thread(started, config))
        consumer = Consumer(stack.enter_context(_catch_up(endpoint)))
        await consumer.goes_on(200)

        # The router is down: history keeps the samples, and the consumer gets them later.
        await router.kill()
        await asyncio.to_thread(first.says, "Zenoh link down")
        there = len(kept(history))
        await asyncio.to_thread(
            until, lambda: len(kept(history)) > there + 500, "history goes on by itself"
        )
        await stack.enter_async_context(ZenohPeer(ZenohMode.ROUTER, listen=[endpoint]))
        await consumer.goes_on(700)

        # The gateway, in the middle of writes.
        client = await stack.enter_async_context(ZenohPeer("client", connect=[endpoint]))
        await client.until_alive("plant/@gateway/*/alive/*", ["plant/@gateway/demo/alive/mixer"])
        [done] = await client.get("plant/mixer/last/@set", b"9")
        assert done.ok
        assert plc.tell("get 1 D 500") == "9"
        [said] = await client.get("plant/@gateway/demo/history")
        writing = asyncio.create_task(
            client.many([(f"plant/mixer/w{n}/@set", b"%d" % (n + 1)) for n in range(WRITES)])
        )
        values = [f"get 1 D {3000 + n}" for n in range(WRITES)]
        await asyncio.to_thread(
            until, lambda: any(plc.tell(value) != "0" for value in values), "a write arrives"
        )
        assert await asyncio.to_thread(first.end, signal.SIGKILL) == -signal.SIGKILL
        for n, replies in enumerate(await writing):
            if any(reply.ok for reply in replies):
                assert plc.tell(values[n]) == str(n + 1)
        left = kept(history)
        assert len(left) >= said.json["stored"]

        # The next one, ended in order under the same load: the last samples are out, and kept.
        second = stack.enter_context(await asyncio.to_thread(started, config))
        await consumer.goes_on(200)
        [done] = await client.get("plant/mixer/last/@set", b"10")
        assert done.ok
        assert plc.tell("get 1 D 500") == "10"
        heard = await client.subscribe("plant/mixer/*")
        await heard.until(lambda h: len(h.samples) > 100)
        asked = time.monotonic()
        assert await asyncio.to_thread(second.end) == 0
        assert time.monotonic() - asked < slowed(WITHIN)
        whole = kept(history)
        last = {key: when for when, key, _ in whole}
        await heard.until(lambda h: {k: s.json["time"] for k, s in h.latest().items()} == last)

        # A third, so that the consumer can ask. It has everything once, and beyond it only what
        # was told, but not yet on disk, when the gateway was killed.
        third = stack.enter_context(await asyncio.to_thread(started, config))
        await asyncio.to_thread(
            until, lambda: set(whole) <= set(consumer.rows), "the consumer knows all that is kept"
        )
        rows = consumer.rows
        assert [row for row, times in Counter(rows).items() if times > 1] == []
        beyond = {row for row in rows if row[0] <= whole[-1][0]} - set(whole)
        assert all(when >= left[-1][0] for when, _, _ in beyond)
        for program in (first, second, third):
            assert not program.has_said("Traceback")
            assert not program.has_said("line down")


def _catch_up(endpoint: str) -> Program:
    yesterday = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() - 86400))
    example = ROOT / "examples" / "catch_up.py"
    return Program(sys.executable, example, "--connect", endpoint, "--since", yesterday)
