"""The gateway's process stands still: a reply that waited must not get a new time stamp."""

import asyncio
import os
import signal
import time
from datetime import datetime
from pathlib import Path

import pytest

from gateway.line.arrival import PERIOD
from tests.attacks.tcp_peer import peer, tcp_reply
from tests.e2e.processes import started, write_config
from tests.zenoh_peer import ZenohPeer, free_endpoint

STANDS = 1.5  # seconds
WAITED = 0x1234  # the value of the reply that waits


def holding(request: bytes, value: int) -> bytes:
    return tcp_reply(request)[:-2] + value.to_bytes(2, "big")


async def test_a_reply_that_waited_while_the_process_stood_still_is_stamped_by_its_arrival(
    tmp_path: Path,
) -> None:
    pid, arrived = 0, 0.0
    subscribed = asyncio.Event()

    async def stops_the_gateway(
        number: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        nonlocal arrived
        turn = 0
        while not subscribed.is_set():  # each value is another one, so each is published
            turn += 1
            writer.write(holding(await reader.readexactly(12), turn))
        request = await reader.readexactly(12)
        os.kill(pid, signal.SIGSTOP)
        try:
            writer.write(holding(request, WAITED))
            await writer.drain()
            arrived = time.time()
            await asyncio.sleep(STANDS)  # the attack itself
        finally:
            os.kill(pid, signal.SIGCONT)
        while True:  # the value stays, so no newer one takes its place
            writer.write(holding(await reader.readexactly(12), WAITED))

    endpoint = free_endpoint()
    async with peer(stops_the_gateway) as port:
        device = {
            "protocol": "modbus-tcp",
            "station": 1,
            "reply_timeout": "10s",
            "tags": {"speed": {"address": "holding:7", "type": "uint16", "every": "200ms"}},
        }
        line = {"port": f"tcp://127.0.0.1:{port}", "devices": {"plc": device}}
        config = write_config(tmp_path / "plant.yaml", endpoint, {"net": line})
        program = await asyncio.to_thread(started, config)
        with program:
            pid = program.pid
            async with ZenohPeer("client", connect=[endpoint]) as client:
                values = await client.subscribe("plant/plc/speed")
                await values.next(lambda s: s.json["quality"] == "good")  # the gateway knows it
                subscribed.set()
                sample = await values.next(lambda s: s.json["value"] == WAITED)
    stamp = datetime.fromisoformat(sample.json["time"]).timestamp()
    # A slow machine makes the stamp older, never newer.
    assert stamp <= arrived + PERIOD + 0.05
    assert stamp == pytest.approx(arrived, abs=STANDS)
