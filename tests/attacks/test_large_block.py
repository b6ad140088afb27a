"""A device with more values than a message of 256 kB holds dies: `watch` shows no good value."""

import asyncio
import json
import sys
from pathlib import Path

from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import Program, started, until, write_config
from tests.zenoh_peer import free_endpoint

TAGS = 4000


async def test_watch_shows_a_dead_device_as_bad_however_large_it_is(tmp_path: Path) -> None:
    endpoint, alive = free_endpoint(), True

    async def plc(_number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            request = await reader.readexactly(12)
            if alive:
                writer.write(tcp_reply(request))

    async with peer(plc) as port:
        tags = {
            f"line/motor/with/a/long/name/{n}": {"address": f"holding:{n}", "type": "uint16"}
            for n in range(TAGS)
        }
        device = {
            "protocol": "modbus-tcp",
            "station": 1,
            "reply_timeout": "1s",
            "retries": 0,
            "blocks": "only",
            "tags": tags,
        }
        lines = {"net": {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}}
        config = write_config(tmp_path / "plant.yaml", endpoint, lines)
        with await asyncio.to_thread(started, config) as gateway:
            await asyncio.to_thread(gateway.says, "device online")
            command = (sys.executable, "-m", "gateway", "watch", config, "--json")
            with Program(*command) as watch:

                def all_are(quality: str) -> bool:
                    rows = (json.loads(line) for line in list(watch.lines))
                    shown = {row["tag"]: row["quality"] for row in rows}
                    return list(shown.values()).count(quality) == TAGS

                await asyncio.to_thread(until, lambda: all_are("good"), "every value is good")
                alive = False
                await asyncio.to_thread(gateway.says, "device offline")
                await asyncio.to_thread(until, lambda: all_are("bad"), "every value is bad")
                watch.lines.clear()
