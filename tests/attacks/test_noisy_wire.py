"""A device alone on a wire that spoils each fifth of its replies, at the running gateway."""

import asyncio
import math
import random
from pathlib import Path

from tests.attacks.slave import crc
from tests.attacks.tcp_peer import peer
from tests.e2e.processes import started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

WORDS, REQUESTS, SPOILED = 10, 400, 0.2


async def test_half_of_the_requests_of_a_noisy_device_give_a_good_value(tmp_path: Path) -> None:
    """Of all, also those that resynchronise. Each register holds the number of the request."""
    number, last, enough, chance = 0, math.inf, asyncio.Event(), random.Random(1)

    async def slave(_: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal number
        while True:
            request = await reader.readexactly(8)
            assert request[1] == 3
            number += 1
            if number >= last:
                enough.set()
            size = 2 * int.from_bytes(request[4:6])
            reply = bytes((1, 3, size)) + number.to_bytes(2) * (size // 2)
            reply += crc(reply)
            if chance.random() < SPOILED:
                at = chance.randrange(len(reply))
                spoiled = reply[at] ^ 1 << chance.randrange(8)
                reply = reply[:at] + bytes((spoiled,)) + reply[at + 1 :]
            writer.write(reply)

    endpoint = free_endpoint()
    async with peer(slave) as port:
        tags = {f"w{n}": {"address": f"holding:{n}", "type": "uint16"} for n in range(WORDS)}
        device = {"protocol": "modbus-rtu", "station": 1, "reply_timeout": "300ms", "tags": tags}
        line = {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}
        defaults = {"every": "20ms"}
        file = write_config(tmp_path / "c.yaml", endpoint, {"hall": line}, defaults=defaults)
        with await asyncio.to_thread(started, file):
            async with ZenohPeer("client", connect=[endpoint]) as client:
                seen = await client.subscribe("plant/plc/w0")
                first, last = number, number + REQUESTS
                async with asyncio.timeout(300):
                    await enough.wait()
    values = {one.json["value"] for one in seen.samples if one.json["quality"] == "good"}
    assert len([value for value in values if value > first]) >= REQUESTS / 2
