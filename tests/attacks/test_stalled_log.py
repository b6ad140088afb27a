"""Nobody reads the log of the gateway: it goes on, and ends when it is asked to."""

import asyncio
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from tests.e2e.processes import PATIENCE, ROOT, station, vigor_line, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

TAGS = {"count": {"address": "D10"}, "recipe": {"address": "D500", "write": True}}


@asynccontextmanager
async def stalled(file: Path) -> AsyncIterator[tuple["subprocess.Popen[bytes]", int]]:
    """A gateway whose stderr is a pipe of one page. Yields its other end, which nobody reads."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    command = [sys.executable, "-m", "gateway", "run", str(file)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=writer, stdin=subprocess.DEVNULL)
    os.close(writer)
    try:
        yield process, reader
    finally:
        process.kill()
        process.wait()
        os.close(reader)


async def test_a_stalled_log_stops_neither_values_nor_writes_nor_the_end(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    tty = tmp_path / "tty"
    file = write_config(tmp_path / "c.yaml", endpoint, {"hall": vigor_line(str(tty), TAGS)})
    link = {"connect/endpoints": [endpoint], "connect/timeout_ms": 300_000}
    with station("pty", str(tty)) as plc:
        plc.tell("count 1 D 10")
        async with (
            stalled(file) as (gateway, reader),
            ZenohPeer("client", connect=[], config=link) as client,
        ):
            heard = await client.subscribe("plant/**")
            await client.until_alive(
                "plant/@gateway/*/alive/*", ["plant/@gateway/demo/alive/mixer"]
            )
            await client.many([("plant/mixer/count/@set", b"7")] * 100)  # each one is logged
            key = "plant/mixer/count"
            heard.forget()
            first = (await heard.next(lambda s: s.key == key and s.json["value"] is not None)).json
            await heard.next(lambda s: s.key == key and (s.json["value"] or 0) > first["value"] + 5)
            [reply] = await client.get("plant/mixer/recipe/@set", b"7")
            assert reply.ok
            gateway.send_signal(signal.SIGTERM)
            assert await asyncio.to_thread(gateway.wait, PATIENCE) == 0
            assert b"write failed" in os.read(reader, 4096)
