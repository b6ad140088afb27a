"""A transfer fills a value that a master reads, and the source of the value dies."""

import asyncio
from pathlib import Path
from typing import Any

from tests.attacks.test_served_lines import Tcp, Wire
from tests.attacks.test_silent_stations import DeviceServer
from tests.e2e.processes import free_port, started, write_config
from tests.serving.easy_link import frame
from tests.serving.test_computer_link import block, request
from tests.zenoh_peer import ZenohPeer, free_endpoint

READ, GOOD, FAILURE = "03 0001 0001", "03 02 00 07", "83 04"
HELD = "03 0002 0001"
OWN = "plant/hmi/speed"
# Reads of D1, and their replies with 7.
LINK = frame(2, "51", "1C0202"), b"\x06" + frame(2, "51", "000700")[1:]
CNET = request("03FFWR0D000101"), block("03FF0007")
LINK_FAILURE, CNET_FAILURE = b"\x06" + frame(2, "51", "28")[1:], b"\x1503FF06"


async def test_a_filled_value_turns_bad_with_its_source_and_returns_with_it(tmp_path: Path) -> None:
    server, number, endpoint = DeviceServer(1), free_port(), free_endpoint()
    ttys, failures = (Wire(), Wire()), (LINK_FAILURE, CNET_FAILURE)
    others = list(zip(("plant/link/a", "plant/cnet/a"), ttys, (LINK, CNET), strict=True))
    server._plcs[1].memory.write("D", 10, [7])
    tags: dict[str, Any] = {
        "speed": {"address": "holding:1", "write": True},
        "last": {"address": "holding:2", "write": True, "hold_last": True},
        "own": {"address": "holding:3", "write": True},
    }
    hmi = {"protocol": "modbus-tcp", "station": 1, "tags": tags}
    source = {"speed": {"address": "D10", "every": "100ms"}}
    hall = {"protocol": "vigor", "station": 1, "reply_timeout": "200ms", "tags": source}
    link = {"protocol": "vigor", "station": 2, "tags": {"a": {"address": "D1", "write": True}}}
    cnet = {**link, "protocol": "computer-link", "station": 3}
    lines = {
        "link": {"port": ttys[0].path, "serve": True, "devices": {"link": link}},
        "cnet": {"port": ttys[1].path, "serve": True, "devices": {"cnet": cnet}},
        "hall": {"port": f"tcp://127.0.0.1:{server.port}", "devices": {"mixer": hall}},
        "panel": {"port": f"tcp://127.0.0.1:{number}", "serve": True, "devices": {"hmi": hmi}},
    }
    filled = ("hmi/speed", "hmi/last", "hmi/own", "link/a", "cnet/a")
    rows = [{"from": "mixer/speed", "to": name} for name in filled]
    file = write_config(tmp_path / "c.yaml", endpoint, lines, transfers=rows)
    try:
        with ttys[0], ttys[1], started(file):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                values = await client.subscribe(OWN)
                master = Tcp(*await asyncio.open_connection("127.0.0.1", number))
                for text in (READ, HELD):
                    await _answers_well(master, text)
                for key, wire, (asked, good) in others:
                    await _turns(client, key, "good")
                    assert await wire.ask(asked, len(good)) == good
                # A client writes the third one: it is no value of the transfer any more.
                [written] = await client.get("plant/hmi/own/@set", b"9")
                assert written.json["value"] == 9
                server.speaking.clear()
                lost = await values.next(lambda s: s.json.get("reason") == "no-reply")
                assert "transfer 1: mixer/speed is bad" in lost.json["detail"]
                assert await master.ask(READ) == FAILURE
                assert await master.ask(HELD) == GOOD  # `hold_last` says so
                assert await master.ask("03 0003 0001") == "03 02 00 09"
                for (key, wire, (asked, _)), failure in zip(others, failures, strict=True):
                    await _turns(client, key, "bad")
                    assert await wire.ask(asked, len(failure)) == failure
                server.speaking.add(1)
                await _answers_well(master, READ)
                await master.close()
    finally:
        server.close()


async def _answers_well(master: Tcp, text: str) -> None:
    async with asyncio.timeout(300):
        while await master.ask(text) != GOOD:
            await asyncio.sleep(0.05)


async def _turns(client: ZenohPeer, key: str, quality: str) -> None:
    async with asyncio.timeout(300):
        while (await client.get(key))[0].json["quality"] != quality:
            await asyncio.sleep(0.05)
