"""A transfer fills a value that a master reads, and the source of the value dies."""

import asyncio
from pathlib import Path
from typing import Any

from tests.attacks.test_served_lines import Tcp
from tests.attacks.test_silent_stations import DeviceServer
from tests.e2e.processes import free_port, started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

READ, GOOD, FAILURE = "03 0001 0001", "03 02 00 07", "83 04"
HELD = "03 0002 0001"
OWN = "plant/hmi/speed"


async def test_a_filled_value_turns_bad_with_its_source_and_returns_with_it(tmp_path: Path) -> None:
    server, number, endpoint = DeviceServer(1), free_port(), free_endpoint()
    server._plcs[1].memory.write("D", 10, [7])
    tags: dict[str, Any] = {
        "speed": {"address": "holding:1", "write": True},
        "last": {"address": "holding:2", "write": True, "hold_last": True},
        "own": {"address": "holding:3", "write": True},
    }
    hmi = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
    source = {"speed": {"address": "D10", "every": "100ms"}}
    hall = {"protocol": "vigor", "station": 1, "reply_timeout": "200ms", "tags": source}
    lines = {
        "hall": {"port": f"tcp://127.0.0.1:{server.port}", "devices": {"mixer": hall}},
        "panel": {"port": f"tcp://127.0.0.1:{number}", "serve": True, "devices": {"hmi": hmi}},
    }
    rows = [{"from": "mixer/speed", "to": f"hmi/{name}"} for name in ("speed", "last", "own")]
    file = write_config(tmp_path / "c.yaml", endpoint, lines, transfers=rows)
    try:
        with started(file):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                values = await client.subscribe(OWN)
                master = Tcp(*await asyncio.open_connection("127.0.0.1", number))
                for text in (READ, HELD):
                    await _answers_well(master, text)
                # A client writes the third one: it is no value of the transfer any more.
                [written] = await client.get("plant/hmi/own/@set", b"9")
                assert written.json["value"] == 9
                server.speaking.clear()
                lost = await values.next(lambda s: s.json.get("reason") == "no-reply")
                assert "transfer 1: mixer/speed is bad" in lost.json["detail"]
                assert await master.ask(READ) == FAILURE
                assert await master.ask(HELD) == GOOD  # `hold_last` says so
                assert await master.ask("03 0003 0001") == "03 02 00 09"
                server.speaking.add(1)
                await _answers_well(master, READ)
                await master.close()
    finally:
        server.close()


async def _answers_well(master: Tcp, text: str) -> None:
    async with asyncio.timeout(300):
        while await master.ask(text) != GOOD:
            await asyncio.sleep(0.05)
